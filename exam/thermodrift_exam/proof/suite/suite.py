"""Suites: cases of a fixed mix in random order, each from a seed derived from the secret of the suite."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal

import numpy as np

from data.errors import InputError
from thermodrift_exam.plants.effects import EFFECTS
from thermodrift_exam.plants.options import stream
from thermodrift_exam.proof.spec import CENTRES, KIND_PLANTS, SIMULATED, CaseSpec, Kind, PlantKind
from thermodrift_exam.proof.suite.other_kinds import could_have, kind_case
from thermodrift_exam.proof.suite.setting import setting
from thermodrift_exam.proof.suite.sizes import size

MIX: Mapping[Kind, float] = MappingProxyType({
    "nothing": 0.16, "decoy": 0.155, "one": 0.375, "two": 0.125, "three": 0.02, "confounded": 0.03, "unlisted": 0.125,
    "invisible": 0.01,
})  # fmt: skip
LACKING: tuple[Kind, ...] = ("one", "two", "three", "confounded", "unlisted", "invisible")  # physics is left out


def counts(cases: int) -> dict[Kind, int]:
    """Cases of each kind that add up to `cases`: the largest remainders are rounded up (Hamilton's method)."""
    exact = {kind: share * cases for kind, share in MIX.items()}
    out = {kind: int(n + 1e-9) for kind, n in exact.items()}
    by_rest = sorted(exact, key=lambda kind: (out[kind] - exact[kind], list(MIX).index(kind)))
    for kind in by_rest[: cases - sum(out.values())]:
        out[kind] += 1
    return out


Which = Literal["development", "sealed"]


def number(seed: bytes | int, which: str, what: str) -> int:
    """256 bits for one purpose that cannot be derived without the seed; development and sealed share none."""
    root = seed if isinstance(seed, bytes) else str(seed).encode()
    message = b"\0".join([b"thermodrift proof", which.encode(), what.encode(), root])
    return int.from_bytes(hashlib.sha256(message).digest(), "big")


def digits(cases: int) -> int:
    """Of the names of so many cases."""
    return max(4, len(str(cases)))


FAULTS = ("sensor_drift", "sensor_lag", "sensor_swap", "time_skew", "wrong_parameter")
IDLE = "idle"  # a decoy that is no term: recorded switches that drive nothing
UNLISTED = tuple(key for key in EFFECTS if key.startswith("unlisted"))
AMBIGUOUS = ("guide_friction",)  # another mechanism has the same equation: only where the kind is "confounded"


def possible(key: str, options: Mapping[str, Any]) -> bool:
    """Whether the plant of these options can have the effect: `has` are the features that its file states."""
    if "has" not in options or key not in EFFECTS:
        return could_have(key, str(options.get("plant")))
    kind, stated = EFFECTS[key], set(options["has"])
    if kind.withholds:
        return kind.withholds not in stated and kind.has - {kind.withholds} <= stated
    return kind.has <= stated


def effects(options: Mapping[str, Any], without: Collection[str] = ()) -> list[str]:
    """Listed physics that a case may have, sorted."""
    others = {*FAULTS, *UNLISTED, *AMBIGUOUS, *without}
    return sorted(key for key in EFFECTS if key not in others and possible(key, options))


def decoys(options: Mapping[str, Any]) -> list[str]:
    """Faults of a recording or of the file; `IDLE` where there are switches that drive nothing."""
    return sorted([*FAULTS, *([IDLE] if options["idle"] else [])])


def unlisted(options: Mapping[str, Any]) -> list[str]:
    """Unlisted effects, sorted."""
    return sorted(key for key in UNLISTED if possible(key, options))


ALWAYS: Mapping[str, tuple[str, ...]] = MappingProxyType({
    "cabinet_heat": ("hydraulic_unit",), "pump_heat": ("electrical_heat", "hydraulic_unit"),
    "guide_friction": ("nut_friction", "screw_bearing"),
})  # fmt: skip
"""By effect the mechanisms that are the same equation under another name, in every recording."""


@dataclass(frozen=True)
class Pair:
    """`alternatives` are, by what a case may lack, the mechanisms that mean the same at its place where the shop has
    this `habit` (None: any) and the machine file states `stated` and not `unstated`.
    """

    alternatives: Mapping[str, tuple[str, ...]]
    habit: str | None = None
    stated: frozenset[str] = frozenset()
    unstated: frozenset[str] = frozenset()

    @property
    def truths(self) -> tuple[str, ...]:
        return tuple(self.alternatives)

    def holds(self, options: Mapping[str, Any]) -> bool:
        """Whether a case of these options has the pair."""
        stated = set(options["has"])
        habit = self.habit in (None, options["habit"])
        return habit and self.stated <= stated and not self.unstated & stated

    def imposed(self, options: Mapping[str, Any]) -> dict[str, Any]:
        """The options, made so that it holds."""
        has = sorted((set(options["has"]) | self.stated) - self.unstated)
        lacks = sorted((set(options["lacks"]) | self.unstated) - self.stated)
        return {**options, "habit": self.habit or options["habit"], "has": has, "lacks": lacks}


PAIRS: Mapping[str, Pair] = MappingProxyType({
    "nose": Pair(
        {"spindle_growth": ("mandrel_fixture",), "mandrel": ("spindle_growth",)},
        habit="long_runs", unstated=frozenset({"growth", "mandrel"}),
    ),
    "one_speed": Pair(
        {"motor_loss": ("belt_loss", "bearing_viscous", "bearing_load")},
        habit="one_speed", unstated=frozenset({"motor_loss"}),
    ),
    "pump": Pair(
        {"pump_heat": ("electrical_heat", "hydraulic_unit"), "cabinet_heat": ("electrical_heat", "hydraulic_unit")},
        habit="coolant_always", stated=frozenset({"coolant"}),
    ),
    "walls": Pair({"radiation": ("natural_convection",)}, habit="walls_as_room", stated=frozenset({"walls"})),
    "feed": Pair({"guide_friction": ("nut_friction", "screw_bearing")}, stated=frozenset({"feed"})),
})  # fmt: skip


def alternatives_of(effect: str, options: Mapping[str, Any]) -> list[str]:
    """Mechanisms that mean the same as an effect where these options hold, sorted."""
    here = [pair.alternatives.get(effect, ()) for pair in PAIRS.values() if pair.holds(options)]
    return sorted({*ALWAYS.get(effect, ()), *(mechanism for named in here for mechanism in named)})


def ambiguous(options: Mapping[str, Any]) -> set[str]:
    """Effects that these options make indistinguishable from another one."""
    return {effect for pair in PAIRS.values() if pair.holds(options) for effect in pair.truths}


HABITUAL = 0.2  # share of the cases with a habit that makes a pair alike, whatever they conceal
SECRET_BYTES = 16


def suite(seed: bytes | int, cases: int, which: Which, plants: Sequence[PlantKind] = CENTRES) -> list[CaseSpec]:
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
    """The case of a seed: first the setting, the same for every kind, then the concealed effects at random."""
    if plant in KIND_PLANTS:
        return kind_case(name, kind, plant, seed, which)
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
    """Six short fixed development cases: nothing, a decoy, one effect on either plant, two, an unlisted one."""
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
    """Probability of a habit that keeps its share equal with and without a concealed effect."""
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
            known = f"{', '.join(SIMULATED[:-1])} or {SIMULATED[-1]}"
            raise InputError(f"suite: plants: got {plant}, expected {known}; name those")
    if cases < 1:
        raise InputError(f"suite: cases: got {cases}, expected 1 or more; request more")
