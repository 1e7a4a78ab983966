"""From a specification to the visible part of a case and its answer key."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from data.batch import Batch
from data.errors import InputError
from data.files import write_atomic
from data.machine import Machine
from data.recording import read_batches
from thermodrift_exam.plants.effects import EFFECTS
from thermodrift_exam.plants.options import stream
from thermodrift_exam.plants.plant import Case, draw, machine_text, recording_texts
from thermodrift_exam.plants.real import SCHEMA
from thermodrift_exam.proof.spec import KIND_PLANTS, REAL, CaseSpec, PlantKind
from thermodrift_exam.proof.suite.other_kinds import drawn_kind, kind_term
from thermodrift_exam.proof.suite.sizes import limit
from thermodrift_exam.proof.suite.suite import Which, alternatives_of, digits, number


@dataclass(frozen=True)
class Built:
    """The machine, its recordings as CSV texts by file name, and the answer key."""

    machine: Machine
    recordings: Mapping[str, str]
    answer: dict[str, Any]


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


def real_suite(
    seed: bytes | int, data: Path, which: Which, plants: Sequence[PlantKind] = REAL, first: int = 1
) -> list[CaseSpec]:
    """Every case whose recordings lie in the folder `data`, in random order, named from number `first` on.

    A grafted case and its reference, the same runs without the graft, have one seed; the case names its reference.

    Raises:
        InputError: a kind of plant that has no real recordings.
    """
    for plant in plants:
        if plant not in REAL:
            raise InputError(f"suite: plants: got {plant!r}, expected {' or '.join(REAL)}; name those")
    known = [(plant, name, _cases(plant).CASES[name]) for plant in plants for name in _cases(plant).cases(data)]
    order = stream(number(seed, which, "real order"), "order").permutation(len(known))
    wide = digits(first + len(known))
    names = {known[int(n)][:2]: f"case_{first + k:0{wide}d}" for k, n in enumerate(order)}
    out = []
    for n in order:
        plant, name, case = known[int(n)]
        options = {"case": name}
        if getattr(case, "reference", name) != name:
            options["reference"] = names[plant, case.reference]
        own = number(seed, which, f"{plant} {case.machine}")
        out.append(CaseSpec(names[plant, name], case.kind, plant, own, options=options, suite=which))
    return out


def build_real(spec: CaseSpec, data: Path) -> Built:
    """A case on the real recordings in the folder `data`.

    Raises:
        InputError: an unknown case, or no recordings there.
    """
    case = _cases(spec.plant).build(spec.options["case"], data, spec.seed)
    answer: dict[str, Any] = {
        **case.answer, "case": spec.name, "suite": spec.suite, "reference": spec.options.get("reference"),
        "options": dict(spec.options), "redraw": spec.plain(),
    }  # fmt: skip
    return Built(case.machine, case.recordings(), answer)


def _cases(plant: str) -> Any:
    return import_module(f"thermodrift_exam.plants.{plant}")


# Heat with positive feedback, and exchange with a small air volume beyond the stability limit of the explicit part,
# are drawn weaker until the simulation is stable.
RUNS_AWAY, WEAKER = ("preload_feedback", "rotating_convection"), 0.7
HOTTEST_DEGC = 90.0
TIMES = 20  # the machine is as hot without it


def build(spec: CaseSpec, data: Path | None = None) -> Built:
    """Draws and simulates a case; the same specification gives the same one. `data` holds the real recordings.

    Raises:
        InputError: an unknown effect, plant or option, a number out of range, or no folder of real recordings.
    """
    if spec.plant in REAL:
        if data is None:
            raise InputError(f"suite: {spec.name}: plant {spec.plant} needs real recordings; give their folder")
        return build_real(spec, data)
    if spec.plant in KIND_PLANTS:
        case = drawn_kind(spec)
        return Built(case.machine, recording_texts(case), answer_of(spec, case))
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
    """Whether a bearing exceeds the temperature at which a machine stops."""
    for batch in case.batches:
        degC = np.stack([batch.values(c) for c in batch.names("temperature")])
        gone = bool(np.isnan(degC[:, -1]).all())  # an absent sensor has no values, but never all sensors
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
    term_of = kind_term if spec.plant in KIND_PLANTS else _term
    terms = [term_of(spec, term) for term in case.truth["terms"]]
    return {
        "schema": SCHEMA,
        "case": spec.name,
        "kind": spec.kind,
        "plant": spec.plant,
        "suite": spec.suite,
        "simulated": True,
        "words": _summary(case.truth["terms"]),
        "machine": case.machine.machine,
        "seed": spec.seed,
        "terms": terms,
        "idle_channels": _idle(case.machine, terms),
        "options": dict(spec.options),
        "redraw": spec.plain(),
    }


def _idle(machine: Machine, terms: list[dict[str, Any]]) -> list[str]:
    """Drivers on which neither the machine file nor a concealed effect depends."""
    stated = [part.get("drivers") or () for part in (machine.twin or {}).get("mechanisms", {}).values()]
    used = {name for drivers in stated for name in _channels(drivers)}
    return [name for name in machine.names("driver") if name not in used | {t["driver"] for t in terms}]


def _channels(drivers: Any) -> list[str]:
    """Of a mechanism's drivers: one name, several, or one by role."""
    if isinstance(drivers, str):
        return [drivers]
    return list(drivers.values() if isinstance(drivers, Mapping) else drivers)


def _term(spec: CaseSpec, term: Mapping[str, Any]) -> dict[str, Any]:
    key = term["effect"]
    partners = alternatives_of(key, spec.options)
    kind = EFFECTS[key]
    return {
        **term,
        "limit_share": round(term["size"] / limit(key, spec.plant), 4),
        "decoy": key in spec.decoys,
        "driver": getattr(kind, "driver", None),
        "same_as": [{"mechanism": mechanism, "where": dict(term["where"])} for mechanism in partners],
    }


def _summary(terms: list[dict[str, Any]]) -> str:
    labels = [f"{t['effect']} at {t['where']['name']} ({t['words']})" if t["words"] else t["effect"] for t in terms]
    return "; ".join(labels) or "nothing is missing"
