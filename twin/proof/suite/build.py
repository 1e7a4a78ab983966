"""From what a case is asked to be to what a diagnosis sees, and to the answer that it does not see."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from data.atomic_file import write_atomic
from data.batch import Batch
from data.machine import Machine
from data.recording import read_batches
from twin.plants.effects import EFFECTS
from twin.plants.plant import Case, draw
from twin.plants.write import machine_text, recording_texts
from twin.proof.spec import CaseSpec
from twin.proof.suite.confounded import rivals_of
from twin.proof.suite.sizes import limit

SCHEMA = "thermodrift.proof_answer/1"


@dataclass(frozen=True)
class Built:
    """A case: the machine, its recordings as CSV texts by file name, and the answer key."""

    machine: Machine
    recordings: Mapping[str, str]
    answer: dict[str, Any]


def build(spec: CaseSpec) -> Built:
    """Draws and simulates a case; the same specification gives the same one.

    Raises:
        InputError: an unknown effect, plant or option, or a number out of range.
    """
    case = draw(spec.seed, sizes={**spec.effects, **spec.decoys}, plant=spec.plant, **spec.options)
    return Built(case.machine, recording_texts(case), answer_of(spec, case))


def without(spec: CaseSpec, *keys: str) -> CaseSpec:
    """The same machine, runs and file with these effects and decoys at size 0; with all of them where none is named."""

    def less(sizes: Mapping[str, float]) -> dict[str, float]:
        return {key: 0.0 if key in keys or not keys else size for key, size in sizes.items()}

    return replace(spec, effects=less(spec.effects), decoys=less(spec.decoys))


def write_built(built: Built, folder: Path) -> None:
    """`machine.yml` and `recordings/*.csv` below a folder, and nothing else."""
    recordings = folder / "recordings"
    recordings.mkdir(parents=True, exist_ok=True)
    write_atomic(folder / "machine.yml", machine_text(built.machine))
    for name, text in built.recordings.items():
        write_atomic(recordings / name, text)


def batches_of(built: Built) -> list[Batch]:
    """The recordings as a reader makes batches of them, by name."""
    with tempfile.TemporaryDirectory() as place:
        write_built(built, Path(place))
        files = sorted((Path(place) / "recordings").iterdir())
        return [batch for file in files for batch in read_batches(file, built.machine)]


def answer_of(spec: CaseSpec, case: Case) -> dict[str, Any]:
    """The answer key: plain data, `thermodrift.proof_answer/1`."""
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
        "terms": [_term(spec, term) for term in case.truth["terms"]],
        "idle_channels": list(spec.options.get("idle", ())),
        "options": dict(spec.options),
        "redraw": plain(spec),
    }


def plain(spec: CaseSpec) -> dict[str, Any]:
    """A specification as plain data; `CaseSpec(**plain(spec))` is the same again."""
    return asdict(replace(spec, effects=dict(spec.effects), decoys=dict(spec.decoys), options=dict(spec.options)))


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
