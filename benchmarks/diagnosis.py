"""Where the time of a diagnosis goes, and how it grows with bodies, candidates and recordings.

    python -m benchmarks.diagnosis [--repeats 3] [--processes 2] [--effect floor_sink]

The case: a plant of 13 bodies drawn from seed 1 whose machine file leaves one effect out, 12 runs of 6 h with a row
every 5 minutes, 9 sensors and 3 error channels, every mechanism of the registry at every place. "stages" is one
diagnosis from end to end; a stage's share is of the wall time. "steps" are single calls in one process on one thread:
CPU time, medians; a step's ratio is to one linearisation of the baseline. Growth is the same steps on other plants,
recordings and lists of candidates; its exponent is of a power law from the first row to the last. Side by side: the
same refits on one and on several processes, wall time. Nothing is asserted.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from data.processes import Processes
from diagnosis.contracts import Candidate, Scored
from diagnosis.diagnose import diagnose
from diagnosis.fitting.fit import Fitted
from diagnosis.fitting.fitted import baseline
from diagnosis.fitting.twins import drawn_misfits
from diagnosis.localisation.where_when import locate
from diagnosis.policy import POLICY
from diagnosis.screening.screen import Screen, proposed, screen
from diagnosis.search.refits import odds_of, refit, shortlist
from thermodrift_exam.plants.plant import Case, draw
from twin.calibration.least_squares import State
from twin.schema import twin_part

GOAL_S, SCREEN_GOAL_S = 30.0, 1.0
PLANTS = (7, 9, 13)  # seeds of 9, 12 and 14 bodies
REFITS = 8  # of the candidates that the screen puts first
STEPS = ("linearise", "assemble", "score a fit", "candidates", "refined twins", "screen", "refit", "locate")
GROWING = ("linearise", "score a fit", "screen", "refit")


@dataclass(frozen=True)
class Posed:
    """A case at its baseline."""

    name: str
    fitted: Fitted
    every: list[Candidate]

    @property
    def size(self) -> str:
        problem = self.fitted.problem
        rows = sum(len(m.row) for m in problem.measured)
        return (
            f"{problem.network.n_cells:6} {len(problem.unknowns):9} {len(self.every):10} "
            f"{len(problem.measured):7} {rows:6}"
        )


SIZE_HEAD = f"{'cells':>6} {'unknowns':>9} {'candidates':>10} {'batches':>7} {'rows':>6}"


def posed(name: str, case: Case) -> Posed:
    fitted = baseline(case.machine, twin_part(case.machine), case.batches, None, len(case.batches))
    return Posed(name, fitted, proposed(fitted))


def timed(work: Callable[[], Any], repeats: int) -> tuple[float, Any]:
    """Median seconds of CPU time, so that other work on the machine counts little, and the last value."""
    took = []
    for _ in range(repeats):
        start = time.process_time()
        value = work()
        took.append(time.process_time() - start)
    return statistics.median(took), value


def steps_of(p: Posed, repeats: int, which: tuple[str, ...] = STEPS) -> Iterator[tuple[str, float]]:
    """The steps of a diagnosis, one by one, and their seconds."""
    fitted, problem, state = p.fitted, p.fitted.problem, p.fitted.state

    def linearised() -> None:
        problem._last.clear()
        list(problem.linearise(fitted.x, fitted.nuisance))

    yield "linearise", timed(linearised, repeats)[0]
    if "assemble" in which:
        yield "assemble", timed(lambda: State.at(problem, state.z, state.nuisance, state.noise), repeats)[0]
    yield "score a fit", timed(lambda: fitted.level.log_evidence(fitted.marginal.grams(fitted.columns)), repeats)[0]
    if "candidates" in which:
        yield "candidates", timed(lambda: proposed(fitted), repeats)[0]
    took, seen = timed(lambda: screen(fitted, p.every), repeats)
    yield "screen", took
    if "refined twins" in which:
        middle, sd = np.zeros(len(fitted.z)), np.ones(len(fitted.z))
        drawn = partial(drawn_misfits, fitted.machine, fitted.part, fitted.batches, problem, middle, sd)
        yield "refined twins", timed(lambda: drawn(POLICY.refined_twins, 0), 1)[0]
    yield "refit", statistics.median(timed(partial(refit, fitted, s), 1)[0] for s in chosen(fitted, seen))
    if "locate" in which:
        yield "locate", timed(lambda: locate(problem, fitted.x, fitted.fitted_nuisance, fitted.batches), 1)[0]


def chosen(fitted: Fitted, seen: Screen) -> list[Scored]:
    return shortlist(fitted, seen, odds_of(fitted, seen))[:REFITS]


def stages_table(case: Case, processes: int) -> None:
    """One diagnosis from end to end."""
    spent: dict[str, float] = {}
    calls: dict[str, int] = {}
    at, since = "begin", time.perf_counter()

    def tell(step: str, done: int, of: int) -> None:
        nonlocal at, since
        now = time.perf_counter()
        spent[at] = spent.get(at, 0.0) + now - since
        calls[step] = calls.get(step, 0) + 1
        at, since = step, now

    start = time.perf_counter()
    found = diagnose(case.machine, case.batches, processes=processes, progress=tell).findings
    total = time.perf_counter() - start
    tell("end", 0, 0)
    print(f"{'stages, one case, ' + str(processes) + ' processes':38} {'wall s':>8} {'share':>7} {'calls':>6}")
    for step, seconds in spent.items():
        print(f"{step:38} {seconds:8.2f} {100 * seconds / total:6.1f}% {calls.get(step, 0):6}")
    what = ", ".join(f"{f.mechanism} at {f.where.name}" for f in found.findings) or "nothing"
    print(f"{'all':38} {total:8.2f} {'':7} {'':6} goal {GOAL_S:.0f} s; {found.verdict}: {what}\n", flush=True)


def steps_table(p: Posed, repeats: int) -> None:
    print(f"{'steps, one thread':38} {'CPU ms':>8} {'ratio':>8}    {SIZE_HEAD}\n{p.name:38} {'':20}{p.size}")
    unit = 0.0
    for step, seconds in steps_of(p, repeats):
        unit = unit or seconds
        goal = f"   goal {1e3 * SCREEN_GOAL_S:.0f} ms" if step == "screen" else ""
        goal = f"   {POLICY.refined_twins} draws" if step == "refined twins" else goal
        print(f"{step:38} {1e3 * seconds:8.1f} {seconds / unit:7.1f}×{goal}", flush=True)
    print()


def growth_table(title: str, cases: Sequence[tuple[float, Posed]], repeats: int) -> None:
    """The same steps on cases of growing size (a number each), and the exponent from the first to the last."""
    print(f"{title:38} {SIZE_HEAD} " + "".join(f"{s + ' ms':>16}" for s in GROWING))
    rows = []
    for size, p in cases:
        rows.append((size, dict(steps_of(p, repeats, GROWING))))
        print(f"{p.name:38} {p.size} " + "".join(f"{1e3 * rows[-1][1][s]:16.1f}" for s in GROWING), flush=True)
    (n, first), (m, last) = rows[0], rows[-1]
    exponents = [np.log(last[s] / first[s]) / np.log(m / n) for s in GROWING]
    print(f"{'exponent':38} {'':{len(SIZE_HEAD)}} " + "".join(f"{e:16.2f}" for e in exponents) + "\n", flush=True)


def side_by_side(p: Posed, processes: int) -> None:
    """The same refits on one process and on several; the second call finds the imports done."""
    work = chosen(p.fitted, screen(p.fitted, p.every))
    print(f"{f'{len(work)} refits side by side':38} {'wall s':>8} {'ratio':>8}")
    one = 0.0
    for n in range(1, processes + 1):
        with Processes(n) as workers:
            list(workers.map(partial(refit, p.fitted), work[:n] * 2))
            start = time.perf_counter()
            list(workers.map(partial(refit, p.fitted), work))
            took = time.perf_counter() - start
        one = one or took
        print(f"{f'{n} process' + ('es' if n > 1 else ''):38} {took:8.2f} {one / took:7.2f}×", flush=True)
    print()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--processes", type=int, default=min(2, os.cpu_count() or 1))
    parser.add_argument("--effect", default="floor_sink")
    args = parser.parse_args()
    print(f"load of the machine {os.getloadavg()[0]:.1f}, {os.cpu_count()} processors\n")
    case = draw(1, args.effect)
    stages_table(case, args.processes)
    with threadpool_limits(limits=1):
        p = posed(f"plant 1 without its {args.effect}", case)
        steps_table(p, args.repeats)
        side_by_side(p, args.processes)
        shares = [replace(p, name=f"1 of {n} candidates", every=p.every[::n]) for n in (8, 4, 2, 1)]
        growth_table("candidates", [(len(s.every), s) for s in shares], args.repeats)
        runs = [(n, posed(f"{n} batches", draw(1, args.effect, batches=n))) for n in (6, 12, 24)]
        growth_table("batches", runs, args.repeats)
        plants = [posed(f"plant {seed}", draw(seed, args.effect)) for seed in PLANTS]
        growth_table("bodies", [(q.fitted.problem.network.n_cells, q) for q in plants], args.repeats)


if __name__ == "__main__":
    main()
