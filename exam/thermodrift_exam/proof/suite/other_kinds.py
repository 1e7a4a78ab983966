"""Cases of machines of other kinds than machining centres: drawn by sigma, built by `plants.kinds`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np

from data.batch import Batch
from data.machine import Machine
from thermodrift_exam.plants.kinds import draw_kind_case, effects_of, execute, unlisted_of
from thermodrift_exam.plants.options import stream
from thermodrift_exam.plants.planned import Executed
from thermodrift_exam.plants.plant import Case
from thermodrift_exam.proof.spec import KIND_PLANTS, CaseSpec, Kind, PlantKind

FAULTS = (
    "sensor_lag", "sensor_drift", "sensor_bonding", "sensor_offset", "sensor_swap", "time_skew", "wrong_capacity",
    "wrong_link", "wrong_heat",
)  # fmt: skip
AMBIGUOUS = ("belt_loss", "natural_convection")  # laws that other laws can imitate in recordings of any machine
SIGMA = (1.5, 25.0)
"""Least and largest sigma of an effect: the rms of what it changes before any recalibration, in units of the noise."""
INVISIBLE_SIGMA = (0.1, 0.6)
DECOYED = 0.5  # share of the cases, of every kind, with idle switches, small offsets and drifts, holes and lost rows
EFFECTS: Mapping[Kind, int] = MappingProxyType({"one": 1, "two": 2, "three": 3, "invisible": 1})


def kind_effects(plant: str) -> list[str]:
    """Listed physics that a case may have alone, sorted."""
    return sorted(set(effects_of(plant)) - {*FAULTS, *AMBIGUOUS})


def could_have(effect: str, plant: str) -> bool:
    """Whether a machine of this kind can have an effect or a fault."""
    return plant in KIND_PLANTS and effect in (*effects_of(plant), *unlisted_of(plant))


def kind_case(name: str, kind: Kind, plant: PlantKind, seed: int, which: Any) -> CaseSpec:
    """The case of a seed: first the setting, the same for every kind of case, then the concealed effects.

    Sizes are sigmas. A machine without a law that others imitate has one effect where the suite wants a confounded one.
    """
    lot = stream(seed, "lot")
    options = {
        "name": f"m{lot.integers(16**8):08x}",
        "plant": plant,
        "decoys": bool(lot.random() < DECOYED),
        "runs": int(lot.integers(8, 13)),
    }
    taken: list[str] = []
    faults: list[str] = []
    pairs = sorted(set(effects_of(plant)) & set(AMBIGUOUS))
    if kind == "decoy":
        faults = _some(lot, sorted(set(effects_of(plant)) & set(FAULTS)), 1)
    elif kind == "confounded" and pairs:
        taken = _some(lot, pairs, 1)
    elif kind == "unlisted":
        taken = _some(lot, sorted(unlisted_of(plant)), 1)
    elif kind != "nothing":
        kind = "one" if kind == "confounded" else kind
        taken = _some(lot, kind_effects(plant), EFFECTS[kind])
    span = INVISIBLE_SIGMA if kind == "invisible" else SIGMA
    return CaseSpec(
        name, kind, plant, seed,
        effects={key: sigma(lot, span) for key in taken}, decoys={key: sigma(lot, span) for key in faults},
        options=options, suite=which,
    )  # fmt: skip


def sigma(rng: np.random.Generator, span: tuple[float, float]) -> float:
    """Log-uniform."""
    low, high = np.log(span)
    return float(f"{np.exp(rng.uniform(low, high)):.4g}")


def _some(lot: np.random.Generator, among: Sequence[str], number: int) -> list[str]:
    return [among[int(k)] for k in lot.choice(len(among), number, replace=False)]


def drawn_kind(spec: CaseSpec) -> Case:
    """The case of a specification, under a neutral name.

    Raises:
        InputError: as `plants.kinds.draw_kind_case`.
    """
    o = spec.options
    wanted = {**spec.effects, **spec.decoys}
    case = draw_kind_case(spec.seed, spec.plant, wanted, decoys=o["decoys"], runs=o["runs"])
    return replace(
        case,
        machine=renamed(case.machine, o["name"]),
        batches=[replace(b, machine=o["name"]) for b in case.batches],
    )


def renamed(machine: Machine, name: str) -> Machine:
    """The machine under another name, since the name from a plant contains its seed."""
    return machine.model_copy(update={"machine": name})


def kind_term(spec: CaseSpec, term: Mapping[str, Any]) -> dict[str, Any]:
    """A term of the answer key. Its strength is its sigma; no detection limit is measured for these machines."""
    return {**term, "limit_share": None, "decoy": term["effect"] in spec.decoys}


def executed_kind(redraw: Mapping[str, Any], plan: str) -> Executed:
    """A proposed run on the plant of a case, `redraw` as its answer key has it.

    Raises:
        InputError: a plan that this plant cannot run.
    """
    o: dict[str, Any] = redraw["options"]
    wanted = {**redraw["effects"], **redraw["decoys"]}
    done = execute(redraw["seed"], wanted, plan, redraw["plant"], decoys=o["decoys"], runs=o["runs"])
    batch: Batch = replace(done.batch, machine=o["name"])
    return replace(done, machine=renamed(done.machine, o["name"]), batch=batch)
