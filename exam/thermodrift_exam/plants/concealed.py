"""The sample machine with one effect that its file lacks, for a demonstration of the diagnosis on simulated runs.

Every effect has a law of its own here; none is the twin's. A foundation and a cabinet store heat, the spindle's shift
saturates, the sun crosses a window, a loose sensor lags twice.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import yaml
from scipy.signal import lfilter

from data.arrays import Array
from data.errors import InputError
from data.files import write_atomic
from plants.sample import sample_machine
from plants.sample.sample_year import (
    PROBE_NOISE_UM,
    SAMPLE_S,
    SENSOR_BONDING,
    SENSOR_OFFSET_K,
    STEP_S,
    Plan,
    csv_text,
    plan_year,
    sensor_degC,
)
from plants.sample.thermal_machine import SpeedHeat, ThermalMachine

MACHINE = "sample_vmc_demonstration"
RUNS = 8
NOTHING_SHARE = 1 / 7  # of the seeds conceal nothing
ERRORS = ("x", "y", "z")


@dataclass(frozen=True)
class Moment:
    """Conditions of the runs: start temperature, floor (B,), degC; clock (S, B), h, of every step."""

    room_degC: Array
    floor_degC: Array
    clock_h: Array


class Concealed:
    """One effect; a subclass draws its size, changes the machine and takes its traces out of the file.

    `kind` and `place` are where it acts: a node, a sensor or an error channel; `also` are places that mean the same.
    """

    key: ClassVar[str]
    kind: ClassVar[str] = "node"
    place: str
    words: str  # for people, with its size
    also: tuple[str, ...] = ()
    parameters: Mapping[str, tuple[float, str]]  # in the names of the mechanism that says the same, with units

    def __init__(self, rng: np.random.Generator) -> None:
        """Draws the size; the base class conceals nothing."""

    def machine(self, machine: ThermalMachine) -> ThermalMachine:
        """The machine with the effect in it."""
        return machine

    def forget(self, twin: dict[str, Any]) -> None:
        """Remove the effect from the twin part of the sample machine's file, in place."""

    def start_degC(self, now: Moment) -> Mapping[str, Array]:
        """Start of the bodies that the effect adds, each (B,)."""
        return {}

    def heat_W(self, now: Moment) -> Mapping[str, Array]:
        """Heat into bodies by the clock, each (S, B)."""
        return {}

    def shift_um(self, share: Array) -> Mapping[str, Array]:
        """Added to error channels, from the share of the rated speed."""
        return {}

    def read(self, shown_degC: dict[str, Array]) -> dict[str, Array]:
        """Readings of the sensors, (S + 1, B) by channel, before the recorder."""
        return shown_degC


class Foundation(Concealed):
    """A concrete slab under the bed that stores heat and keeps the ground's temperature."""

    key, place = "floor_sink", "bed"
    SLAB_J_PER_K, GROUND_W_PER_K = 20e6, 60.0

    def __init__(self, rng: np.random.Generator) -> None:
        self.joint_W_per_K = float(rng.uniform(18.0, 40.0))
        self.words = f"the foundation exchanges heat with the bed through {self.joint_W_per_K:.0f} W/K"
        self.parameters = {"conductance": (self.joint_W_per_K, "W/K")}

    def machine(self, machine: ThermalMachine) -> ThermalMachine:
        return replace(
            machine,
            capacity_J_per_K={**machine.capacity_J_per_K, "slab": self.SLAB_J_PER_K},
            link_W_per_K={**machine.link_W_per_K, ("bed", "slab"): self.joint_W_per_K},
            floor_W_per_K={"slab": self.GROUND_W_PER_K},
        )

    def forget(self, twin: dict[str, Any]) -> None:
        del twin["surroundings"]["floor"], twin["exposures"]["bed-floor"]

    def start_degC(self, now: Moment) -> Mapping[str, Array]:
        return {"slab": now.floor_degC}


class Cabinet(Concealed):
    """A control cabinet on the column's back, switched on with the machine; its sheet metal warms up first."""

    key, place = "cabinet_heat", "column_back"
    SHEET_J_PER_K, ROOM_W_PER_K, COLUMN_W_PER_K = 15e3, 5.0, 9.0

    def __init__(self, rng: np.random.Generator) -> None:
        self.loss_W = float(rng.uniform(250.0, 400.0))
        reaching_W = self.loss_W * self.COLUMN_W_PER_K / (self.COLUMN_W_PER_K + self.ROOM_W_PER_K)
        self.words = f"a control cabinet brings {reaching_W:.0f} W into the column's back"
        self.parameters = {"heat": (reaching_W, "W")}

    def machine(self, machine: ThermalMachine) -> ThermalMachine:
        return replace(
            machine,
            capacity_J_per_K={**machine.capacity_J_per_K, "cabinet": self.SHEET_J_PER_K},
            link_W_per_K={**machine.link_W_per_K, ("cabinet", "column_back"): self.COLUMN_W_PER_K},
            room_W_per_K={**machine.room_W_per_K, "cabinet": self.ROOM_W_PER_K},
            always_W={**machine.always_W, "cabinet": self.loss_W},
        )

    def start_degC(self, now: Moment) -> Mapping[str, Array]:
        return {"cabinet": now.room_degC}


class MotorLosses(Concealed):
    """The file lacks the losses of the motor; here they are a power of the speed in addition to idling losses."""

    key, place = "motor_loss", "motor"
    POWER = 1.6

    def __init__(self, rng: np.random.Generator) -> None:
        self.idle_W, self.rated_W = float(rng.uniform(30.0, 60.0)), float(rng.uniform(140.0, 240.0))
        self.words = f"the motor loses {self.idle_W + self.rated_W:.0f} W at 6000 rpm"
        # the tangent's split of x^1.6 does not matter: amounts are compared at the rated speed
        self.parameters = {
            "idle": (self.idle_W, "W"), "linear": (0.4 * self.rated_W, "W"), "quadratic": (0.6 * self.rated_W, "W"),
            "rated": (sample_machine.RATED_RPM, "rpm"),
        }  # fmt: skip

    def machine(self, machine: ThermalMachine) -> ThermalMachine:
        others = tuple(h for h in machine.heats if h.body != self.place)
        return replace(
            machine, heats=(*others, SpeedHeat(self.place, ((self.idle_W, 0.0), (self.rated_W, self.POWER))))
        )

    def forget(self, twin: dict[str, Any]) -> None:
        del twin["mechanisms"]["motor_loss"]


class Bending(Concealed):
    """The error chains of the file lack the bending of the column, which is that of the sample machine."""

    key, kind, place, also = "column_bending", "error", "y", ("z",)

    def __init__(self, rng: np.random.Generator) -> None:
        self.words = "the column bends when its front is warmer than its back"
        self.parameters = {}

    def forget(self, twin: dict[str, Any]) -> None:
        for channel in (self.place, *self.also):
            del twin["errors"][channel]["tilts"]


class SpindleShift(Concealed):
    """The spindle moves along its axis with the speed; the preload's stiffening takes a part of it back."""

    key, kind, place = "speed_shift", "error", "z"
    STIFFENING = 0.15

    def __init__(self, rng: np.random.Generator) -> None:
        self.rated_um = float(rng.uniform(9.0, 16.0))
        self.words = f"the spindle moves by {self.rated_um:.0f} µm at 6000 rpm"
        self.parameters = {"shift": (self.rated_um, "um"), "rated": (sample_machine.RATED_RPM, "rpm")}

    def machine(self, machine: ThermalMachine) -> ThermalMachine:
        return replace(machine, speed_shift_um={})

    def forget(self, twin: dict[str, Any]) -> None:
        del twin["mechanisms"]["speed_shift"]

    def shift_um(self, share: Array) -> Mapping[str, Array]:
        return {"z": self.rated_um * ((1 + self.STIFFENING) * share**2 - self.STIFFENING * share**4)}


class LooseSensor(Concealed):
    """A sensor that has come loose: its pocket and then its own body follow late, one after the other."""

    key, kind = "sensor_lag", "sensor"

    def __init__(self, rng: np.random.Generator) -> None:
        self.place = str(rng.choice(["front", "rear", "motor"]))
        self.lags_s = tuple(float(rng.uniform(300.0, 600.0)) for _ in range(2))
        self.words = f"the sensor {self.place} has come loose and follows {sum(self.lags_s) / 60:.0f} min late"
        self.parameters = {"lag": (sum(self.lags_s), "s")}

    def read(self, shown_degC: dict[str, Array]) -> dict[str, Array]:
        late = shown_degC[self.place]
        for lag_s in self.lags_s:
            keep = np.exp(-STEP_S / lag_s)
            late = lfilter([1 - keep], [1, -keep], late, axis=0, zi=keep * late[:1])[0]
        return {**shown_degC, self.place: late}


class Swapped(Concealed):
    """Two sensors with exchanged names."""

    key, kind = "sensor_swap", "sensor"
    PAIRS = (("rear", "motor"), ("head_front", "column_front"), ("front", "head_rear"))

    def __init__(self, rng: np.random.Generator) -> None:
        self.place, other = self.PAIRS[int(rng.integers(len(self.PAIRS)))]
        self.also = (other,)
        self.words = f"the sensors {self.place} and {other} are exchanged"
        self.parameters = {}

    def read(self, shown_degC: dict[str, Array]) -> dict[str, Array]:
        one, other = self.place, self.also[0]
        return {**shown_degC, one: shown_degC[other], other: shown_degC[one]}


class Window(Concealed):
    """Sun through a window onto the column's back: half an hour to come in, half an hour to leave, even between."""

    key, place = "sun", "column_back"
    EDGE_H = 0.5

    def __init__(self, rng: np.random.Generator) -> None:
        self.power_W = float(rng.uniform(200.0, 350.0))
        self.rise_h = float(rng.uniform(8.5, 10.0))
        self.set_h = self.rise_h + float(rng.uniform(2.5, 3.5))
        hours = f"{self.rise_h:.1f} to {self.set_h:.1f} h"
        self.words = f"the sun on the column's back brings up to {self.power_W:.0f} W from {hours}"
        self.parameters = {"power": (self.power_W, "W"), "rise": (self.rise_h, "h"), "set": (self.set_h, "h")}

    def heat_W(self, now: Moment) -> Mapping[str, Array]:
        inward, outward = (now.clock_h - self.rise_h) / self.EDGE_H, (self.set_h - now.clock_h) / self.EDGE_H
        return {self.place: self.power_W * np.clip(np.minimum(inward, outward), 0.0, 1.0)}


EFFECTS: Mapping[str, type[Concealed]] = {
    e.key: e for e in (Foundation, Cabinet, MotorLosses, Bending, SpindleShift, LooseSensor, Swapped, Window)
}


@dataclass(frozen=True)
class Case:
    """`effect` None: nothing is concealed. `machine_file` and `recordings` (by file name) are what may be seen."""

    effect: Concealed | None
    machine_file: str
    recordings: Mapping[str, str] = field(repr=False)

    @property
    def answer(self) -> dict[str, Any]:
        """The concealed effect as plain data: effect, words, and `terms` with mechanism, place and values."""
        e = self.effect
        if e is None:
            return {"simulated": True, "effect": None, "words": "nothing", "terms": []}
        where = {"kind": e.kind, "name": e.place}
        values = {k: {"value": v, "unit": u} for k, (v, u) in e.parameters.items()}
        term = {"effect": e.key, "mechanism": e.key, "where": where, "also": list(e.also), "parameters": values,
                "words": e.words, "neighbours": _neighbours(e)}  # fmt: skip
        return {"simulated": True, "effect": e.key, "words": e.words, "terms": [term]}


def drawn(seed: int) -> str:
    """The concealed effect of a seed: a key of `EFFECTS`, or "nothing" for one seed in seven."""
    rng = np.random.default_rng([seed, 71])
    return "nothing" if rng.random() < NOTHING_SHARE else str(rng.choice(list(EFFECTS)))


def conceal(seed: int, effect: str | None = None, runs: int = RUNS) -> Case:
    """A case drawn from a seed: which effect (or, in one of seven, none), its size and the scatter of the runs.

    Args:
        effect: a key of `EFFECTS` or "nothing", instead of the one that the seed draws.

    Raises:
        InputError: a negative seed, an unknown effect, or a number of runs that no year has.
    """
    if seed < 0:
        raise InputError(f"demonstration: seed: got {seed}, expected 0 or more; choose another number")
    if effect is not None and effect not in (*EFFECTS, "nothing"):
        raise InputError(f"demonstration: effect: got {effect!r}, expected one of {', '.join(EFFECTS)} or nothing")
    key, rng = effect or drawn(seed), np.random.default_rng([seed, 73])
    chosen = None if key == "nothing" else EFFECTS[key](rng)
    # friction that varies between runs would be a second effect
    plans = [replace(p, friction=1.0) for p in plan_year(seed, runs)]
    return Case(chosen, _machine_file(chosen), _recordings(chosen or Concealed(rng), plans, seed))


def write_case(case: Case, folder: Path) -> Path:
    """Write `machine.yml` and `recordings/*.csv` below `folder`, without the answer; returns the machine file."""
    machine, recordings = folder / "machine.yml", folder / "recordings"
    recordings.mkdir(parents=True, exist_ok=True)
    write_atomic(machine, case.machine_file)
    for name, text in case.recordings.items():
        write_atomic(recordings / name, text)
    return machine


def _machine_file(effect: Concealed | None) -> str:
    """The sample machine's file under another name, without the effect."""
    plain = yaml.load(sample_machine.FILE.read_bytes(), yaml.CSafeLoader)
    plain["machine"] = MACHINE
    if effect is not None:
        effect.forget(plain["twin"])
    head = "# The sample machine for a demonstration; its recordings are simulated and may hold what it does not say.\n"
    return head + yaml.safe_dump(plain, sort_keys=False, width=120, allow_unicode=True)


def _neighbours(effect: Concealed) -> list[str]:
    """Bodies that touch the place; the enclosure's air touches too many to count."""
    if effect.kind != "node":
        return []
    touching = {b for pair in sample_machine.LINK_W_PER_K if effect.place in pair for b in pair}
    return sorted(touching - {effect.place, "air"})


def _recordings(effect: Concealed, plans: Sequence[Plan], seed: int) -> dict[str, str]:
    """The runs as a measuring system writes them, by file name."""
    machine = effect.machine(sample_machine.machine())
    steps = int(max(p.duration_s for p in plans) / STEP_S)
    time_s = np.arange(steps + 1, dtype=np.float64) * np.float64(STEP_S)
    room_degC = np.stack([p.room_at(time_s) for p in plans], axis=1)
    speed_rpm = np.stack([p.speed_at(time_s) for p in plans], axis=1)
    node_degC = _simulated(effect, machine, plans, time_s, room_degC, speed_rpm)
    error_um = machine.error_um(node_degC - node_degC[0], speed_rpm)
    for channel, um in effect.shift_um(speed_rpm / machine.rated_rpm).items():
        error_um[channel] = error_um[channel] + um
    true = {n: room_degC if n == "room" else node_degC[..., machine.place[n]] for n in SENSOR_OFFSET_K}
    shown = {n: sensor_degC(degC, room_degC, SENSOR_BONDING) + SENSOR_OFFSET_K[n] for n, degC in true.items()}
    shown = effect.read(shown)
    out = {}
    for b, plan in enumerate(plans):
        rows = slice(0, int(plan.duration_s / STEP_S) + 1, int(SAMPLE_S / STEP_S))
        noise = np.random.default_rng([seed, 72, b])
        temperatures = {n: v[rows, b] for n, v in shown.items()}
        errors = {c: error_um[c][rows, b] for c in ERRORS}
        noisy = {c: v + noise.normal(0.0, PROBE_NOISE_UM, len(v)) for c, v in errors.items()}
        out[plan.name] = csv_text("a demonstration", plan, temperatures, speed_rpm[rows, b], noisy)
    return out


def _simulated(
    effect: Concealed, machine: ThermalMachine, plans: Sequence[Plan], time_s: Array, room_degC: Array, speed_rpm: Array
) -> Array:
    """Temperatures (S + 1, B, N) of all runs."""
    begin_h = np.array([p.start.hour + p.start.minute / 60 for p in plans])
    floor_degC = np.array([p.floor_degC for p in plans])
    now = Moment(room_degC[0], floor_degC, begin_h + (time_s[:-1, None] + STEP_S / 2) / 3600)
    start = np.stack([p.start_nodes_degC() for p in plans])
    added = effect.start_degC(now)
    start = np.concatenate([start, *(degC[:, None] for degC in added.values())], axis=1)
    heat_W = np.zeros((len(time_s) - 1, len(plans), len(machine.bodies)))
    for body, watts in effect.heat_W(now).items():
        heat_W[..., machine.place[body]] += watts
    middle_degC = (room_degC[:-1] + room_degC[1:]) / 2
    friction = np.array([p.friction for p in plans])
    return machine.simulate(speed_rpm[:-1], middle_degC, floor_degC, start, friction, STEP_S, heat_W)
