"""Does the diagnosis hold on machines of other kinds?

    python -m benchmarks.kinds --kinds lathe board --cases 12 --out var/kinds

Draws cases of the proof for every kind (nothing missing, one effect, an effect of no list), diagnoses each, and prints
by kind: effects named first (of those that are visible at all, and of all), cases of one effect that claim anything,
false alarms, unlisted effects flagged, and seconds of CPU. Every case keeps the criteria of its rounds, and the rank
and gain of the true candidate next to the winner's. Cases that are done are not done again; `--workers` side by side.
The proof (`thermodrift prove --plants …`) asks the same under seal, with baselines.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from data.errors import InputError, WorkError
from data.processes import Processes
from diagnosis.contracts import Candidate, Fitted
from diagnosis.diagnose import diagnose
from diagnosis.fitting.batches import usable_batches
from diagnosis.fitting.fitted import left_out_rows
from diagnosis.result import Diagnosis
from diagnosis.search.acceptance import flipped_threshold, least_gain
from diagnosis.search.decision import Round, agreed_on
from evidence.proof.scoring.answer_key import AnswerKey, Spot
from evidence.proof.scoring.matching import names_term
from evidence.proof.scoring.true_model import TrueModel, true_model
from evidence.proof.spec import KIND_PLANTS, Kind, PlantKind
from evidence.proof.suite.build import answer_of
from evidence.proof.suite.other_kinds import drawn_kind, kind_case
from twin.compile import compile_network
from twin.schema import TwinPart, twin_part

SHARES: dict[Kind, float] = {"nothing": 0.4, "one": 0.45, "unlisted": 0.15}
SHOWN = 10


def examined(kind: PlantKind, seed: int, out: str) -> dict[str, Any]:
    """One case, from its file where it is done already."""
    path = Path(out) / f"{kind}_{seed}.json"
    if path.exists():
        return dict(json.loads(path.read_text()))
    drawn = 1000 * (1 + KIND_PLANTS.index(kind)) + seed  # of its own: equal seeds give kinds equal effects and sizes
    what = np.random.default_rng(drawn).choice(list(SHARES), p=list(SHARES.values()))
    spec = kind_case("case_0001", what, kind, drawn, "development")
    case = drawn_kind(spec)
    answer = answer_of(spec, case)
    key = AnswerKey.from_json(answer)
    begun = time.process_time()
    row: dict[str, Any] = {"kind": kind, "seed": seed, "what": what, "terms": case.truth["terms"]}
    try:
        with threadpool_limits(limits=1):
            part = twin_part(case.machine)
            batches, _ = usable_batches(compile_network(case.machine, part=part), case.batches)
            row |= _answered(diagnose(case.machine, batches), key, part)
            row["cpu_s"] = round(time.process_time() - begun, 1)
            if what == "one":
                row |= _visible(true_model(case.machine, batches, answer))
    except (InputError, WorkError) as error:
        row["trouble"] = str(error)
    path.write_text(json.dumps(row, default=float))
    return row


def _answered(done: Diagnosis, key: AnswerKey, part: TwinPart) -> dict[str, Any]:
    """The claims of a diagnosis, whether the first is right, and the criteria of its rounds."""
    found = done.findings
    bodies = {name: sensor.at.partition("@")[0] for name, sensor in part.sensors.items()}
    first = found.findings[0] if found.findings else None
    right = (
        first is not None
        and bool(key.terms)
        and names_term(first.mechanism, Spot(first.where.kind, first.where.name), key.terms[0], bodies)
    )
    listed = [
        {"name": f"{f.mechanism} {f.where.name}", "gain": f.evidence.get("gain_nats", 0.0)} for f in found.findings
    ]
    rounds = [_round(r, key, bodies) for r in done.search.rounds] if done.search is not None else []
    return {"right": right, "listed": listed, "verdict": found.verdict, "rounds": rounds}


def _visible(truth: TrueModel) -> dict[str, Any]:
    """Whether the true effects, refitted, cut a left-out error by a tenth and gain more than structure does."""
    return {"visible": list(truth.visible), "true_gain": truth.gain_nats, "true_structure": truth.threshold_nats,
            "true_least": truth.bar_nats}  # fmt: skip


def _round(r: Round, key: AnswerKey, bodies: Mapping[str, str]) -> dict[str, Any]:
    """The criteria of a round, its best refits, and how far the true candidate came: rank and gain in the screen."""
    n = len(r.before.batches)

    def right(c: Candidate) -> bool:
        return any(names_term(c.mechanism, Spot(c.where.kind, c.where.name), term, bodies) for term in key.terms)

    refits = [t for t in r.tried if t.fitted is not None]
    tried = [
        {"name": t.candidate.name, "gain": t.gain, "level": t.level, "improved": t.improved, "worse": t.worse,
         "least": least_gain(t),
         "structure": r.null.threshold(r.density, name=t.candidate.name), "agreed": agreed_on(t, n),
         "physics": t.candidate.kind.is_physics, "right": right(t.candidate), "refit": k,
         "left_out": _left_out(t.fitted)}
        for k, t in enumerate(refits) if k < SHOWN or right(t.candidate)
    ]  # fmt: skip
    screened = [
        {"name": s.candidate.name, "screen": k, "gain": s.gain, "absorbed": s.absorbed}
        for k, s in enumerate(r.screen.scored) if right(s.candidate)
    ]  # fmt: skip
    return {
        "accepted": r.accepted, "threshold": r.threshold, "flipped": flipped_threshold(r.flipped, n),
        "batches": n, "tried": tried, "before": _left_out(r.before),
        "refits": len(refits), "screened": len(r.screen.scored), "true": screened[:SHOWN],
    }  # fmt: skip


def _left_out(fitted: Fitted | None) -> list[list[float]]:
    """Root mean squares left out, in the channels' units, by channel (rows) and batch."""
    if fitted is None:
        return []
    rms = left_out_rows(fitted).rms
    return [[float(v) for v in own["rms"]] for _, own in rms.groupby("channel")]


def table(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """One line a kind, and one for all."""
    out = ["kind        n none/one/unl   named of visible   named of one   claims   false alarms   unlisted   CPU s"]
    kinds = sorted({r["kind"] for r in rows})
    for kind in [*kinds, "all"]:
        own = [r for r in rows if kind in ("all", r["kind"]) and "verdict" in r]
        if not own:
            continue
        none, one, unlisted = ([r for r in own if r["what"] == what] for what in SHARES)
        seen = [r for r in one if any(r.get("visible", ()))]
        cells = [
            f"{sum(r['right'] for r in seen):>4} of {len(seen):<4}",
            f"{sum(r['right'] for r in one):>4} of {len(one):<4}",
            f"{sum(bool(r['listed']) for r in one):>4}",
            f"{sum(bool(r['listed']) for r in none):>4} of {len(none):<4}",
            f"{sum(bool(r['listed']) for r in unlisted):>4} of {len(unlisted):<4}",
            f"{np.median([r['cpu_s'] for r in own]):6.1f}",
        ]
        out.append(f"{kind:<11} {len(none):>3} {len(one):>3} {len(unlisted):>3}   " + "   ".join(cells))
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--kinds", nargs="+", default=["lathe", "board"], choices=KIND_PLANTS)
    parser.add_argument("--cases", type=int, default=12, help="of each kind")
    parser.add_argument("--first", type=int, default=0, help="seed of the first case")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("var/kinds"))
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    tasks = [(kind, given.first + k, str(given.out)) for k in range(given.cases) for kind in given.kinds]
    rows = []
    with Processes(given.workers) as pool:
        for k, row in pool.completed(examined, tasks):
            rows.append(row)
            effect = "+".join(f"{t['effect']} {t.get('sigma', 0):.1f}" for t in row["terms"]) or row["what"]
            first = next(iter(row.get("listed", ())), {"name": row.get("trouble", "no claim")})
            print(f"{tasks[k][0]:<10} {effect:<28} {first['name'][:60]}  {row['cpu_s']:.0f} s", flush=True)
    print("\n".join(table(rows)))


if __name__ == "__main__":
    main()
