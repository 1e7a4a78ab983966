"""From what a case is asked to be to what a diagnosis sees, and to the answer that it does not see."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from data.errors import InputError
from data.machine import Machine
from twin.plants.effects import EFFECTS
from twin.plants.plant import Case, draw
from twin.plants.write import recording_texts
from twin.proof.spec import CaseSpec
from twin.proof.suite.built import Built
from twin.proof.suite.confounded import rivals_of
from twin.proof.suite.real import REAL, build_real
from twin.proof.suite.sizes import limit

SCHEMA = "thermodrift.proof_answer/1"
# Heat that grows with itself, and more exchange with a little air than a plant's explicit part is stable at: drawn
# weaker until the machine survives.
RUNS_AWAY, WEAKER = ("preload_feedback", "rotating_convection"), 0.7
HOTTEST_DEGC = 90.0
TIMES = 20  # then the machine is as hot without it


def build(spec: CaseSpec, data: Path | None = None) -> Built:
    """Draws and simulates a case; the same specification gives the same one. `data` holds the real recordings.

    Raises:
        InputError: an unknown effect, plant or option, a number out of range, or no folder of real recordings.
    """
    if spec.plant in REAL:
        if data is None:
            raise InputError(f"suite: {spec.name}: plant {spec.plant} needs real recordings; give their folder")
        return build_real(spec, data)
    case = _drawn(spec)
    for _ in range(TIMES if any(spec.effects.get(key) for key in RUNS_AWAY) else 0):
        if not _seized(case):
            break
        spec = replace(spec, effects={k: v * (WEAKER if k in RUNS_AWAY else 1.0) for k, v in spec.effects.items()})
        case = _drawn(spec)
    return Built(case.machine, recording_texts(case), answer_of(spec, case))


def _drawn(spec: CaseSpec) -> Case:
    with np.errstate(over="ignore", invalid="ignore"):
        return draw(spec.seed, sizes={**spec.effects, **spec.decoys}, plant=spec.plant, **spec.options)


def _seized(case: Case) -> bool:
    """Whether a bearing ran so hot that no machine would have gone on."""
    for batch in case.batches:
        degC = np.stack([batch.values(c) for c in batch.names("temperature")])
        gone = bool(np.isnan(degC[:, -1]).all())  # an absent sensor shows nothing either, but never all of them
        if gone or np.nanmax(degC, initial=-np.inf) > HOTTEST_DEGC:
            return True
    return False


def without(spec: CaseSpec, *keys: str) -> CaseSpec:
    """The same machine, runs and file with these effects and decoys at size 0; with all of them where none is named."""

    def less(sizes: Mapping[str, float]) -> dict[str, float]:
        return {key: 0.0 if key in keys or not keys else size for key, size in sizes.items()}

    return replace(spec, effects=less(spec.effects), decoys=less(spec.decoys))


def answer_of(spec: CaseSpec, case: Case) -> dict[str, Any]:
    """The answer key: plain data, `thermodrift.proof_answer/1`."""
    terms = [_term(spec, term) for term in case.truth["terms"]]
    return {
        "schema": SCHEMA,
        "case": spec.name,
        "kind": spec.kind,
        "plant": spec.plant,
        "suite": spec.suite,
        "simulated": True,
        "words": _words(case.truth["terms"]),
        "machine": case.machine.machine,
        "seed": spec.seed,
        "terms": terms,
        "idle_channels": _idle(case.machine, terms),
        "options": dict(spec.options),
        "redraw": spec.plain(),
    }


def _idle(machine: Machine, terms: list[dict[str, Any]]) -> list[str]:
    """Drivers that neither the machine file nor anything left out of it depends on."""
    stated = [part.get("drivers", ()) for part in (machine.twin or {})["mechanisms"].values()]
    used = {name for drivers in stated for name in ([drivers] if isinstance(drivers, str) else drivers)}
    return [name for name in machine.names("driver") if name not in used | {t["driver"] for t in terms}]


def _term(spec: CaseSpec, term: Mapping[str, Any]) -> dict[str, Any]:
    key = term["effect"]
    partners = rivals_of(key, spec.options)
    kind = EFFECTS[key]
    return {
        **term,
        "limit_share": round(term["size"] / limit(key, spec.plant), 4),
        "decoy": key in spec.decoys,
        "driver": getattr(kind, "driver", None),
        "same_as": [{"mechanism": mechanism, "where": dict(term["where"])} for mechanism in partners],
    }


def _words(terms: list[dict[str, Any]]) -> str:
    said = [f"{t['effect']} at {t['where']['name']} ({t['words']})" if t["words"] else t["effect"] for t in terms]
    return "; ".join(said) or "nothing is missing"
