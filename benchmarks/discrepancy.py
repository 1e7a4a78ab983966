"""Does the simulated structural discrepancy tell missing physics from structure on machines of other kinds?

    python -m benchmarks.discrepancy --kinds lathe board --cases 12 --out var/discrepancy

Draws cases of the proof for every kind (nothing missing, one effect, an effect of no list), runs one round of
`diagnosis.structure` on each, and prints by kind: the area under the curve of nothing against one by the score in
thresholds, effects named first without a false alarm and at the threshold, false alarms, and seconds of CPU. Cases that
are done are kept and not done again; `--workers` side by side.
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
from diagnosis.diagnose import diagnose
from diagnosis.fitting.batches import usable_batches
from diagnosis.result import Diagnosis
from diagnosis.search.acceptance import least_gain
from diagnosis.search.decision import Round, agreed_on
from diagnosis.structure.fit import baseline
from diagnosis.structure.naming import Refit, detect
from evidence.proof.scoring.answer_key import AnswerKey, Spot
from evidence.proof.scoring.matching import names_term
from evidence.proof.spec import KIND_PLANTS, Kind, PlantKind
from evidence.proof.suite.build import answer_of
from evidence.proof.suite.other_kinds import drawn_kind, kind_case
from twin.compile import compile_network
from twin.schema import TwinPart, twin_part

SHARES: dict[Kind, float] = {"nothing": 0.4, "one": 0.45, "unlisted": 0.15}
SHOWN = 10


def examined(kind: PlantKind, seed: int, out: str, engine: str = "structure") -> dict[str, Any]:
    """One case, from its file where it is done already; `engine` is `structure`, or `search`: the diagnosis."""
    path = Path(out) / f"{engine}_{kind}_{seed}.json"
    if path.exists():
        return dict(json.loads(path.read_text()))
    what = np.random.default_rng(seed).choice(list(SHARES), p=list(SHARES.values()))
    spec = kind_case("case_0001", what, kind, seed, "development")
    case = drawn_kind(spec)
    key = AnswerKey.from_json(answer_of(spec, case))
    begun = time.process_time()
    row: dict[str, Any] = {"kind": kind, "seed": seed, "what": what, "terms": case.truth["terms"]}
    try:
        with threadpool_limits(limits=1):
            part = twin_part(case.machine)
            batches, _ = usable_batches(compile_network(case.machine, part=part), case.batches)
            if engine == "search":
                row |= _searched(diagnose(case.machine, batches), key, part)
                row["cpu_s"] = round(time.process_time() - begun, 1)
                path.write_text(json.dumps(row, default=float))
                return row
            found = detect(baseline(case.machine, part, batches), 0)
        row |= {
            "threshold": found.threshold, "score": found.score, "null": np.sort(found.null.gain).round(2).tolist(),
            "right": _names(found.best, key, part),
            "listed": [_plain(r) for r in found.listed], "free": [_plain(r) for r in found.free],
            "screen": [_scored(s) for s in found.screen.scored[:SHOWN]], "inflation": dict(found.screen.inflation),
            "rows": found.before.problem.measured[0].row.size, "candidates": len(found.screen.scored),
        }  # fmt: skip
    except (InputError, WorkError) as error:
        row["trouble"] = str(error)
    row["cpu_s"] = round(time.process_time() - begun, 1)
    path.write_text(json.dumps(row, default=float))
    return row


def _searched(done: Diagnosis, key: AnswerKey, part: TwinPart) -> dict[str, Any]:
    """The answer of the diagnosis: above 1 where it claims something."""
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
    score = 2.0 if found.findings else 0.0
    return {"score": score, "right": right, "listed": listed, "verdict": found.verdict, "rounds": rounds}


def _round(r: Round, key: AnswerKey, bodies: Mapping[str, str]) -> dict[str, Any]:
    """The criteria of a round and its best refits."""
    n = len(r.before.batches)
    tried = [
        {"name": t.candidate.name, "gain": t.gain, "level": t.level, "improved": t.improved, "least": least_gain(t, n),
         "structure": r.null.threshold(r.density, name=t.candidate.name), "agreed": agreed_on(t, n),
         "physics": t.candidate.kind.is_physics,
         "right": bool(key.terms) and any(
             names_term(t.candidate.mechanism, Spot(t.candidate.where.kind, t.candidate.where.name), term, bodies)
             for term in key.terms)}
        for t in r.tried[:SHOWN] if t.fitted is not None
    ]  # fmt: skip
    return {"accepted": r.accepted, "threshold": r.threshold, "batches": n, "tried": tried}


def _plain(r: Refit) -> dict[str, Any]:
    c = r.candidate
    return {"name": c.name, "mechanism": c.mechanism, "kind": c.where.kind, "place": c.where.name, "gain": r.gain,
            "level": r.level, "screen": r.scored.gain}  # fmt: skip


def _scored(s: Any) -> dict[str, Any]:
    c = s.candidate
    return {"name": c.name, "mechanism": c.mechanism, "kind": c.where.kind, "place": c.where.name, "gain": s.gain}


def _names(best: Refit | None, key: AnswerKey, part: TwinPart) -> bool:
    """Whether a refit names the one effect, by the rules of the proof."""
    if best is None or not key.terms:
        return False
    c = best.candidate
    bodies = {name: sensor.at.partition("@")[0] for name, sensor in part.sensors.items()}
    return names_term(c.mechanism, Spot(c.where.kind, c.where.name), key.terms[0], bodies)


def table(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """One line a kind, and one for all."""
    head = "kind        n none/one/unl   AUC   named, no false alarm   named   false alarms   unlisted   CPU s"
    out = [head]
    kinds = sorted({r["kind"] for r in rows})
    for kind in [*kinds, "all"]:
        own = [r for r in rows if kind in ("all", r["kind"]) and "score" in r]
        none, one, unlisted = ([r for r in own if r["what"] == what] for what in SHARES)
        if not none or not one:
            continue
        a, b = np.array([r["score"] for r in none]), np.array([r["score"] for r in one])
        auc = float(np.mean((b[:, None] > a) + 0.5 * (b[:, None] == a)))
        first = [r["right"] for r in one]
        clean = sum(f and s > a.max() for f, s in zip(first, b, strict=True))
        named = sum(f and s > 1.0 for f, s in zip(first, b, strict=True))
        flagged = sum(r["score"] > 1.0 for r in unlisted)
        cpu = np.median([r["cpu_s"] for r in own])
        false = int(np.sum(a > 1.0))
        out.append(
            f"{kind:<11} {len(none):>3} {len(one):>3} {len(unlisted):>3}  {auc:6.2f}   {clean:>3} of {len(one):<10}"
            f"  {named:>3} of {len(one):<3} {false:>5} of {len(none):<4} {flagged:>4} of {len(unlisted):<3} {cpu:8.1f}"
        )
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--kinds", nargs="+", default=["lathe", "board"], choices=KIND_PLANTS)
    parser.add_argument("--cases", type=int, default=12, help="of each kind")
    parser.add_argument("--first", type=int, default=0, help="seed of the first case")
    parser.add_argument("--engine", default="structure", choices=["structure", "search"])
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("var/discrepancy"))
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    tasks = [(kind, given.first + k, str(given.out), given.engine) for k in range(given.cases) for kind in given.kinds]
    rows = []
    with Processes(given.workers) as pool:
        for k, row in pool.completed(examined, tasks):
            rows.append(row)
            best = next(iter(row.get("listed", ())), {"name": row.get("trouble", "none"), "gain": 0.0})
            effect = "+".join(f"{t['effect']} {t.get('sigma', 0):.1f}" for t in row["terms"]) or "nothing"
            print(f"{tasks[k][0]:<10} {effect:<30} score {row.get('score', 0):6.2f}  {best['name'][:50]} "
                  f"{best['gain']:.0f} nats  {row['cpu_s']:.0f} s", flush=True)  # fmt: skip
    print("\n".join(table(rows)))


if __name__ == "__main__":
    main()
