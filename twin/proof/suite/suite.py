"""Suites: cases of a fixed mix in an order drawn by lot, each from a seed that only the suite's secret gives."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from data.errors import InputError
from twin.plants.seeds import stream
from twin.proof.spec import CaseSpec, Kind, PlantKind
from twin.proof.suite.confounded import PAIRS, ambiguous
from twin.proof.suite.eligible import IDLE, decoys, effects, unlisted
from twin.proof.suite.mix import LACKING, MIX, counts
from twin.proof.suite.secret import Which, digits, number
from twin.proof.suite.setting import setting
from twin.proof.suite.sizes import size

SIMULATED: tuple[PlantKind, ...] = ("elements", "volumes")
HABITUAL = 0.2  # share of the cases that have what makes a pair alike, whatever they lack
SECRET_BYTES = 16


def suite(seed: bytes | int, cases: int, which: Which, plants: Sequence[PlantKind] = SIMULATED) -> list[CaseSpec]:
    """The cases of a suite; the same seed gives the same ones.

    `seed` is a secret of 128 bits or more for a sealed suite, any number for a development one. The two share no case.

    Raises:
        InputError: a sealed suite from less than 128 bits, no plant or one of another kind, or no case.
    """
    _check(seed, cases, which, plants)
    lot = stream(number(seed, which, "order"), "order")
    kinds = [kind for kind, n in counts(cases).items() for _ in range(n)]
    first = int(lot.integers(len(plants)))
    planned = [(kind, plants[(k + first) % len(plants)]) for k, kind in enumerate(kinds)]
    wide = digits(cases)
    return [
        case(f"case_{k + 1:0{wide}d}", *planned[int(n)], number(seed, which, f"case {k + 1}"), which)
        for k, n in enumerate(lot.permutation(cases))
    ]


def case(name: str, kind: Kind, plant: PlantKind, seed: int, which: Which) -> CaseSpec:
    """The case of a seed: first the setting, the same for every kind, then by lot what it lacks."""
    lot = stream(seed, "lot")
    options = setting(seed, which)
    share = 1.0 if kind == "confounded" else _habitual(kind)
    pair = list(PAIRS.values())[int(lot.integers(len(PAIRS)))]
    if lot.random() < share:
        options = pair.imposed(options)
    taken: list[str] = []
    faults: list[str] = []
    if kind == "decoy":
        faults = _some(lot, decoys(options), 1)
    elif kind == "confounded":
        taken = _some(lot, pair.truths, 1)
    elif kind == "unlisted":
        taken = _some(lot, unlisted(options), 1)
    elif kind != "nothing":
        taken = _some(lot, effects(options, ambiguous(options)), {"two": 2, "three": 3}.get(kind, 1))
    return CaseSpec(
        name, kind, plant, seed,
        effects={key: size(key, plant, kind, lot) for key in taken},
        decoys={key: size(key, plant, kind, lot) for key in faults if key != IDLE},
        options=options, suite=which,
    )  # fmt: skip


def small_suite() -> list[CaseSpec]:
    """Six short development cases that never change: nothing, a decoy, one on either plant, two, an unlisted one."""
    wanted: tuple[tuple[Kind, PlantKind, dict[str, float], dict[str, float]], ...] = (
        ("nothing", "volumes", {}, {}),
        ("decoy", "volumes", {}, {"sensor_drift": 1.5}),
        ("one", "elements", {"cabinet_heat": 2.0}, {}),
        ("one", "volumes", {"pump_heat": 1.0}, {}),
        ("two", "volumes", {"cabinet_heat": 2.0, "speed_shift": 2.0}, {}),
        ("unlisted", "volumes", {"unlisted_warm_speed": 3.0}, {}),
    )
    out = []
    for k, (kind, plant, lacking, faults) in enumerate(wanted, 1):
        seed = number(b"small", "development", f"case {k}")
        options = {**setting(seed, "development"), "batches": 6, "hours": 4.0, "step_s": 300.0, "idle": []}
        out.append(CaseSpec(f"case_{k:04d}", kind, plant, seed, lacking, faults, options))
    return out


def _habitual(kind: Kind) -> float:
    """Chance of a habit that keeps its share the same with and without physics left out."""
    if kind not in LACKING:
        return HABITUAL
    whole, forced = sum(MIX[k] for k in LACKING), MIX["confounded"]
    return (HABITUAL * whole - forced) / (whole - forced)


def _some(lot: np.random.Generator, among: Sequence[str], number: int) -> list[str]:
    return [among[int(k)] for k in lot.choice(len(among), number, replace=False)]


def _check(seed: bytes | int, cases: int, which: str, plants: Sequence[Any]) -> None:
    if which == "sealed" and not (isinstance(seed, bytes) and len(seed) >= SECRET_BYTES):
        got = f"{8 * len(seed)} bits" if isinstance(seed, bytes) else f"the number {seed}"
        raise InputError(f"suite: seed: got {got}, expected {8 * SECRET_BYTES} bits or more; draw a secret")
    for plant in plants or ("none",):
        if plant not in SIMULATED:
            raise InputError(f"suite: plants: got {plant}, expected {' or '.join(SIMULATED)}; name those")
    if cases < 1:
        raise InputError(f"suite: cases: got {cases}, expected 1 or more; ask for more")
