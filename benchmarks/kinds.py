"""Does the diagnosis hold on machines of other kinds?

    python -m benchmarks.kinds --kinds lathe board --cases 12 --out var/kinds
    python -m benchmarks.kinds --paired 870000 --table var/diagnosis_kinds.csv
    python -m benchmarks.kinds --paired 700000 --claims results/claims.csv
    python -m benchmarks.kinds --withheld ../shared/data --table results/diagnosis_withheld.csv

Draws cases of the proof for every kind (nothing missing, one effect or two, one of no list), diagnoses each, and prints
by kind: effects named (of those that are visible at all, and of all), claims and how many of them are true, false
alarms, cases of two effects with both named, unlisted effects flagged, and seconds of CPU. An effect is named where a
finding, or an explanation that these recordings cannot distinguish from it, has its mechanism and its place. Cases that
are done are not done again; `--workers` side by side. `--paired` takes of every kind ten cases with one effect of at
least `--noises` times its noise, seven with none and three with two, by seeds from the number given; `--table` stores a
row for each. `--claims` stores the likeliest claim of the first round of each instead, and prints the offset and weight
of a claim's probability (`POLICY.claim_offset`) that are fitted to them. `--withheld` takes real recordings whose
machine file lacks what it is known to need. The proof (`thermodrift prove --plants …`) asks the
same under seal, with baselines.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pandas as pd
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import roc_auc_score
from sklearn.model_selection import LeaveOneGroupOut, cross_val_predict
from threadpoolctl import threadpool_limits

from benchmarks.results import write
from data.arrays import Array
from data.batch import Batch
from data.errors import InputError, WorkError
from data.machine import Machine
from data.processes import Processes
from diagnosis.contracts import Candidate
from diagnosis.diagnose import diagnose
from diagnosis.fitting.batches import usable_batches
from diagnosis.fitting.fitted import baseline
from diagnosis.result import Diagnosis
from diagnosis.search.claims import Round, indistinguishable
from diagnosis.search.search import one_round
from reports.diagnosis.tables import by_channel
from thermodrift_exam.plants.plant import Case
from thermodrift_exam.plants.real import recorded
from thermodrift_exam.plants.withheld import CASES, build, cases
from thermodrift_exam.proof.scoring.answer_key import AnswerKey, Spot
from thermodrift_exam.proof.scoring.matching import names_term
from thermodrift_exam.proof.scoring.true_model import TrueModel, true_model
from thermodrift_exam.proof.spec import KIND_PLANTS, CaseSpec, Kind, PlantKind
from thermodrift_exam.proof.suite.build import answer_of
from thermodrift_exam.proof.suite.other_kinds import drawn_kind, executed_kind, kind_case
from twin.compile import compile_network
from twin.schema import TwinPart, twin_part

PAIRED: dict[Kind, int] = {"one": 10, "nothing": 7, "two": 3}  # cases of each kind
SHARES: dict[Kind, float] = {"nothing": 0.4, "one": 0.45, "unlisted": 0.15}
SHOWN = 10
LEAST_GAIN = 1e-9  # relative: smaller gains count as equal


def examined(
    kind: PlantKind, seed: int, out: str, proposed: int = 0, paired: Kind | None = None, noises: float = 3.0
) -> dict[str, Any]:
    """One case, from its file where it is done already; with so many proposed runs after the first answer.

    Args:
        paired: what the case conceals; by default it is drawn.
        noises: least size of the effect of a paired case, by the noise of the channel that it moves most.
    """
    path = Path(out) / f"{kind}_{seed}{f'_{paired}' if paired else ''}.json"
    if path.exists():
        return dict(json.loads(path.read_text()))
    spec, case = _drawn(kind, seed, paired, noises)
    row = {"kind": kind, "seed": spec.seed if paired else seed, "what": spec.kind, "terms": case.truth["terms"]}
    return _diagnosed(path, row, case.machine, case.batches, answer_of(spec, case), proposed)


def of_withheld(name: str, data: str, out: str) -> dict[str, Any]:
    """A case of real recordings whose machine file lacks what it is known to need, as a row of `examined`."""
    path = Path(out) / f"{name}.json"
    if path.exists():
        return dict(json.loads(path.read_text()))
    case, about = build(name, Path(data), seed=1), CASES[name]
    row = {"kind": about.machine, "seed": name, "what": about.kind, "terms": case.answer["terms"]}
    _, full = recorded(about.machine, Path(data), seed=1)
    hidden = {b.batch_id: (b.time_s, b.values(channel)) for channel in about.channels for b in full}
    return _diagnosed(path, row, case.machine, case.batches, case.answer, hidden=hidden)


def _diagnosed(
    path: Path, row: dict[str, Any], machine: Machine, given: Sequence[Batch], answer: Mapping[str, Any],
    proposed: int = 0, hidden: Mapping[str, tuple[Array, Array]] = MappingProxyType({}),
) -> dict[str, Any]:  # fmt: skip
    """The row with the diagnosis of a case and its judgement, kept in a file."""
    key, begun = AnswerKey.from_json(answer), time.process_time()
    try:
        with threadpool_limits(limits=1):
            part, batches = (twin_part(machine) if machine.twin is not None else None), list(given)
            if part is not None:
                batches, _ = usable_batches(compile_network(machine, part=part), batches)
            done = diagnose(machine, batches)
            row |= _answered(done, key, part or done.part_before)
            row |= _left_out(done) | (_recovered(done, hidden) if hidden else {})
            row["cpu_s"] = round(time.process_time() - begun, 1)
            row["proposed"] = list(_proposed(done, machine, batches, answer["redraw"], key, proposed))
            if row["what"] in ("one", "two"):
                row |= _visible(true_model(machine, batches, answer, done.search.baseline if done.search else None))
    except (InputError, WorkError) as error:
        row["trouble"] = str(error)
    path.write_text(json.dumps(row, default=float))
    return row


def _drawn(kind: PlantKind, seed: int, paired: Kind | None, noises: float) -> tuple[CaseSpec, Case]:
    """A case; of a paired one the first whose effects are large enough."""
    drawn = 1000 * (1 + KIND_PLANTS.index(kind)) + seed  # of its own: equal seeds give kinds equal effects and sizes
    what = paired or np.random.default_rng(drawn).choice(list(SHARES), p=list(SHARES.values()))
    while True:
        spec = kind_case("case_0001", what, kind, drawn, "development")
        case = drawn_kind(spec)
        if paired is None or min((t["sigma"] for t in case.truth["terms"]), default=np.inf) >= noises:
            return spec, case
        drawn += 1


def first_round(kind: PlantKind, seed: int, out: str, paired: Kind, noises: float) -> dict[str, Any]:
    """The first round of a paired case, as a row of `claims`; from its file where it is done already."""
    path = Path(out) / f"{kind}_{seed}_{paired}_first.json"
    if path.exists():
        return dict(json.loads(path.read_text()))
    spec, case = _drawn(kind, seed, paired, noises)
    key, part = AnswerKey.from_json(answer_of(spec, case)), twin_part(case.machine)
    bodies = {name: sensor.at.partition("@")[0] for name, sensor in part.sensors.items()}
    begun = time.process_time()
    with threadpool_limits(limits=1):
        batches, _ = usable_batches(compile_network(case.machine, part=part), case.batches)
        done = one_round(baseline(case.machine, part, batches), Processes(), lambda step, n, of: None)
    row = {"kind": kind, "seed": spec.seed, "what": paired, "terms": case.truth["terms"],
           "rounds": [_round(done, key, bodies)], "cpu_s": round(time.process_time() - begun, 1)}  # fmt: skip
    path.write_text(json.dumps(row, default=float))
    return row


def _answered(done: Diagnosis, key: AnswerKey, part: TwinPart) -> dict[str, Any]:
    """The claims of a diagnosis with the terms that each names, whether the first is right, and the rounds' figures."""
    found = done.findings
    bodies = {name: sensor.at.partition("@")[0] for name, sensor in part.sensors.items()}
    listed = []
    for f in found.findings:
        same = [(a.mechanism, a.where) for a in f.alternatives if a.alike]
        every = [(m, Spot(where.kind, where.name)) for m, where in [(f.mechanism, f.where), *same]]
        of = [k for k, term in enumerate(key.terms) if any(names_term(m, at, term, bodies) for m, at in every)]
        listed.append({
            "name": f"{f.mechanism} {f.where.name}", "gain": f.evidence.get("gain_nats", 0.0), "of": of,
            "alike": len(every), "probability": f.probability,
        })  # fmt: skip
    right = bool(listed) and bool(listed[0]["of"])
    rounds = [_round(r, key, bodies) for r in done.search.rounds] if done.search is not None else []
    return {"right": right, "listed": listed, "verdict": found.verdict, "rounds": rounds}


def _proposed(
    done: Diagnosis, machine: Machine, batches: Sequence[Batch], redraw: Mapping[str, Any], key: AnswerKey, runs: int
) -> Iterator[dict[str, Any]]:
    """The answers after one, two, … proposed runs, each executed on the plant, until none is proposed."""
    batches = list(batches)
    for k in range(1, runs + 1):
        proposal = done.findings.next_experiment
        if done.plan_text is None or proposal is None:
            return
        about = {"run": proposal.run, "separates": proposal.separates}
        try:
            run = executed_kind(redraw, done.plan_text.replace("name: ", f"name: proposed {k}, ", 1))
        except InputError as error:  # a plan that this plant cannot run
            yield about | {"trouble": str(error)}
            return
        if len(run.machine.channels) > len(machine.channels):  # one more sensor, which stays on the machine
            machine = run.machine
        batches.append(replace(run.batch, batch_id=f"proposed_{k}"))
        done = diagnose(machine, batches)
        yield about | _answered(done, key, twin_part(machine))


def _left_out(done: Diagnosis) -> dict[str, Any]:
    """What is left of the error in runs left out once the findings are modelled, a share; channels count alike."""
    rms = by_channel(done.tables["rms"])
    return {"left_share": float((rms["after"] / rms["before"]).mean())}


def _recovered(done: Diagnosis, hidden: Mapping[str, tuple[Array, Array]]) -> dict[str, Any]:
    """Where the free series of heat stands out most from its standard deviation, and its correlation with the hidden
    input over all runs, whose times (s) and values these are by run."""
    flux = done.tables["flux"].dropna(subset=["value", "sd"])
    flux = flux[flux["kind"] == "heat"]
    if flux.empty:
        return {}
    strength = ((flux["value"] / flux["sd"]) ** 2).groupby(flux["place"]).mean()
    own = flux[flux["place"] == strength.idxmax()]
    given = np.concatenate([np.interp(g["time_s"], *hidden[str(b)]) for b, g in own.groupby("batch", sort=False)])
    value = np.concatenate([g["value"].to_numpy() for _, g in own.groupby("batch", sort=False)])
    return {"place": str(strength.idxmax()), "r": float(np.corrcoef(given, value)[0, 1])}


def _visible(truth: TrueModel) -> dict[str, Any]:
    """Whether the true effects, refitted, are visible (`proof.scoring.true_model`)."""
    return {"visible": list(truth.visible), "true_gain": truth.gain_nats}


def _round(r: Round, key: AnswerKey, bodies: Mapping[str, str]) -> dict[str, Any]:
    """The likeliest claim of a round with its figures, its best refits, and the true candidate's rank in the screen."""

    def right(c: Candidate) -> bool:
        return any(names_term(c.mechanism, Spot(c.where.kind, c.where.name), term, bodies) for term in key.terms)

    same = [t for t in r.tried if r.best is not None and (t is r.best or indistinguishable(r.best, t))]
    tried = [{"name": t.candidate.name, "gain": t.gain, "right": right(t.candidate)} for t in r.tried]
    screened = [
        {"name": s.candidate.name, "screen": k, "gain": s.gain, "absorbed": s.absorbed}
        for k, s in enumerate(r.screen.scored) if right(s.candidate)
    ]  # fmt: skip
    return {
        "accepted": r.accepted, "trust": r.claim_probability, "right": any(right(t.candidate) for t in same),
        "figures": asdict(r.figures) if r.figures else None, "evidence": r.before.log_evidence,
        "lead_rows": r.before.lead_rows, "hyper": asdict(r.before.hyper), "tried": tried,
        "screened": len(r.screen.scored), "true": screened[:SHOWN],
    }  # fmt: skip


def after_proposed(rows: Sequence[Mapping[str, Any]], runs: int) -> list[str]:
    """One line for each number of proposed runs, over all kinds: effects named first, claims, false alarms."""
    out = []
    for k in range(runs + 1):
        named = {"one": 0, "nothing": 0, "unlisted": 0, "right": 0, "made": 0}
        for r in rows:
            if "verdict" not in r:
                continue
            answers = [r, *(a for a in r.get("proposed", ()) if "verdict" in a)]
            answer = answers[min(k, len(answers) - 1)]  # the last one stays where no further run is proposed
            named["made"] += len(answers) > k
            named[r["what"]] += bool(answer["listed"])
            named["right"] += r["what"] == "one" and answer["right"]
        of = {what: sum(r["what"] == what and "verdict" in r for r in rows) for what in SHARES}
        out.append(
            f"after {k} proposed runs ({named['made']} made): {named['right']} of {of['one']} single effects named, "
            f"{named['one']} claim anything, {named['nothing']} of {of['nothing']} false alarms, "
            f"{named['unlisted']} of {of['unlisted']} unlisted flagged"
        )
    return out


def table(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """One line a kind, and one for all."""
    out = [
        "kind        n none/one/two/unl   named of visible   named of one   true of claims   false alarms   "
        "both of two   unlisted   CPU s"
    ]
    for kind in [*sorted({r["kind"] for r in rows}), "all"]:
        own = [r for r in rows if kind in ("all", r["kind"]) and "verdict" in r]
        if not own:
            continue
        none, one, two, unlisted = ([r for r in own if r["what"] == w] for w in ("nothing", "one", "two", "unlisted"))
        seen = [r for r in one if any(r.get("visible", ()))]
        made = [f for r in (*none, *one, *two) for f in r["listed"]]
        cells = [
            f"{sum(_named(r) for r in seen):>4} of {len(seen):<4}",
            f"{sum(_named(r) for r in one):>4} of {len(one):<4}",
            f"{sum(bool(f['of']) for f in made):>4} of {len(made):<4}",
            f"{sum(bool(r['listed']) for r in none):>4} of {len(none):<4}",
            f"{sum(_named(r) == 2 for r in two):>4} of {len(two):<4}",
            f"{sum(bool(r['listed']) for r in unlisted):>4} of {len(unlisted):<4}",
            f"{np.median([r['cpu_s'] for r in own]):6.1f}",
        ]  # fmt: skip
        counts = " ".join(f"{len(c):>3}" for c in (none, one, two, unlisted))
        out.append(f"{kind:<11} {counts}   " + "   ".join(cells))
    return out


def _named(r: Mapping[str, Any]) -> int:
    """How many of the concealed effects its findings name."""
    return len({k for f in r["listed"] for k in f["of"]})


def pairs(kinds: Sequence[PlantKind], first: int) -> list[tuple[PlantKind, int, Kind]]:
    """Kind, seed and what is concealed of the cases of `--paired`, in turn over the kinds."""
    return [
        (kind, first - 1000 + 100 * k, what)
        for k in range(max(PAIRED.values())) for what, n in PAIRED.items() if k < n for kind in kinds
    ]  # fmt: skip


def as_rows(rows: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """What was concealed, whether it is visible, what was claimed, and how much of that is true; a row a case."""
    found = []
    for r in rows:
        effects = r["what"] in ("one", "two")
        found.append({
            "kind": r["kind"], "seed": r["seed"],
            "concealed": "+".join(t["effect"] for t in r["terms"]) or "nothing",
            "sigmas": " ".join(f"{t.get('sigma', 0):.1f}" for t in r["terms"]),
            "visible": sum(bool(v) for v in r.get("visible", ())) if effects else "",
            "claimed": "; ".join(f["name"] for f in r.get("listed", ())),
            "true": sum(bool(f["of"]) for f in r.get("listed", ())),
            "named": _named(r) if effects and "verdict" in r else "", "cpu_s": round(r.get("cpu_s", 0.0)),
            **({"left_share": round(r["left_share"], 3)} if "left_share" in r else {}),
            **({"stands_out": r["place"], "r_hidden": round(r["r"], 2)} if "place" in r else {}),
        })  # fmt: skip
    return pd.DataFrame(found).sort_values(["kind", "seed", "concealed"])


def claims(rows: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """The likeliest claim of every first round, accepted or not, with its figures, and whether it is right."""
    found = [
        {
            "kind": r["kind"], "seed": r["seed"],
            "concealed": "+".join(t["effect"] for t in r["terms"]) or "nothing",
            "claim": a["tried"][0]["name"], "gain_nats": round(a["tried"][0]["gain"], 1),
            **{name: round(value, 5) for name, value in a["figures"].items()}, "right": "yes" if a["right"] else "no",
        }
        for r in rows for a in r["rounds"] if a["figures"]
    ]  # fmt: skip
    return pd.DataFrame(found).sort_values(["kind", "seed", "concealed"])


def fitted_weights(table: pd.DataFrame) -> str:
    """Offset and weight of the logarithm of the relative gain, and how well other kinds than a claim's predict it."""
    x = np.log(np.maximum(table["relative_gain"].to_numpy(), LEAST_GAIN))[:, None]
    right, kind = (table["right"] == "yes").to_numpy(), table["kind"].to_numpy()
    probability = cross_val_predict(
        LogisticRegression(C=np.inf), x, right, groups=kind, cv=LeaveOneGroupOut(), method="predict_proba"
    )[:, 1]
    loss = -np.log(np.where(right, probability, 1.0 - probability))
    fit = LogisticRegression(C=np.inf).fit(x, right)
    return (
        f"claim_offset {fit.intercept_[0]:.2f}, claim_weight {fit.coef_[0, 0]:.2f} of {len(x)} claims, {right.sum()} "
        f"of them right; kinds left out in turn: log loss {loss.mean():.3f} ± {loss.std() / np.sqrt(len(loss)):.3f}, "
        f"area {roc_auc_score(right, probability):.2f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--kinds", nargs="+", choices=KIND_PLANTS, help="default: lathe and board; all with --paired")
    parser.add_argument("--paired", type=int, help="seed of the first pair")
    parser.add_argument("--table", type=Path, help="where a row for each case goes, .csv")
    parser.add_argument("--noises", type=float, default=3.0, help="least size of the effect of a paired case")
    parser.add_argument("--claims", type=Path, help="where the claim of each first round goes, .csv")
    parser.add_argument("--cases", type=int, default=12, help="of each kind")
    parser.add_argument("--first", type=int, default=0, help="seed of the first case")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--proposed", type=int, default=0, help="proposed runs that are executed after the answer")
    parser.add_argument("--withheld", type=Path, help="folder of real recordings; their cases instead of drawn ones")
    parser.add_argument("--machines", nargs="+", default=["tclab_board", "cell_30q"], help="of --withheld")
    parser.add_argument("--out", type=Path, default=Path("var/kinds"))
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    tasks: list[tuple[Any, ...]] = []
    work: Callable[..., dict[str, Any]] = first_round if given.claims else examined
    if given.withheld is not None:
        work = of_withheld
        names = [n for n in cases(given.withheld) if CASES[n].machine in given.machines]
        tasks += [(name, str(given.withheld), str(given.out)) for name in names]
    elif given.paired is not None:
        proposed = () if given.claims else (0,)
        every = pairs(given.kinds or KIND_PLANTS, given.paired)
        tasks += [(kind, seed, str(given.out), *proposed, what, given.noises) for kind, seed, what in every]
    else:
        seeds, kinds = range(given.first, given.first + given.cases), given.kinds or ["lathe", "board"]
        tasks += [(kind, seed, str(given.out), given.proposed) for seed in seeds for kind in kinds]
    rows = []
    with Processes(given.workers) as pool:
        for k, row in pool.completed(work, tasks):
            rows.append(row)
            effect = "+".join(f"{t['effect']} {t.get('sigma', 0):.1f}" for t in row["terms"]) or row["what"]
            first = row["rounds"][0]["tried"][:1] if given.claims else row.get("listed", ())
            said = next((claim["name"] for claim in first), row.get("trouble", "no claim"))
            print(f"{tasks[k][0]:<10} {effect:<28} {said[:60]}  {row.get('cpu_s', 0):.0f} s", flush=True)
    if given.table:
        of = f"--paired {given.paired}"
        if given.withheld is not None:
            of = f"--withheld {given.withheld} --machines {' '.join(given.machines)}"
        write(given.table, as_rows(rows), f"python -m benchmarks.kinds {of} --table {given.table}")
    if given.claims:
        stored = claims(rows)
        write(given.claims, stored, f"python -m benchmarks.kinds --paired {given.paired} --claims {given.claims}")
        if stored["kind"].nunique() > 1:  # each is left out in turn
            print(fitted_weights(stored))
        return
    print("\n".join([*table(rows), *(after_proposed(rows, given.proposed) if given.proposed else ())]))


if __name__ == "__main__":
    main()
