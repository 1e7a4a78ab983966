"""Does the diagnosis hold on machines of other kinds?

    python -m benchmarks.kinds --kinds lathe board --cases 12 --out var/kinds

Draws cases of the proof for every kind (nothing missing, one effect, an effect of no list), diagnoses each, and prints
by kind: effects named first, effects whose case claims anything, false alarms, unlisted effects flagged, and seconds of
CPU. Every case keeps the criteria of its rounds. Cases that are done are not done again; `--workers` side by side. The
proof (`thermodrift prove --plants …`) asks the same under seal, with baselines.
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
from evidence.proof.scoring.answer_key import AnswerKey, Spot
from evidence.proof.scoring.matching import names_term
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
            row |= _answered(diagnose(case.machine, batches), key, part)
    except (InputError, WorkError) as error:
        row["trouble"] = str(error)
    row["cpu_s"] = round(time.process_time() - begun, 1)
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


def table(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """One line a kind, and one for all."""
    out = ["kind        n none/one/unl   named first   claims something   false alarms   unlisted   CPU s"]
    kinds = sorted({r["kind"] for r in rows})
    for kind in [*kinds, "all"]:
        own = [r for r in rows if kind in ("all", r["kind"]) and "verdict" in r]
        if not own:
            continue
        none, one, unlisted = ([r for r in own if r["what"] == what] for what in SHARES)
        named, claimed = sum(r["right"] for r in one), sum(bool(r["listed"]) for r in one)
        false, flagged = (sum(bool(r["listed"]) for r in some) for some in (none, unlisted))
        cpu_s = np.median([r["cpu_s"] for r in own])
        out.append(
            f"{kind:<11} {len(none):>3} {len(one):>3} {len(unlisted):>3}  {named:>4} of {len(one):<4} {claimed:>8} of "
            f"{len(one):<4} {false:>10} of {len(none):<4} {flagged:>5} of {len(unlisted):<4} {cpu_s:6.1f}"
        )
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
