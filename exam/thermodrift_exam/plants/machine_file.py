"""The machine file that an engineer would write of a plant: lumped, with inexact values, without the effect."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from data.machine import Machine
from thermodrift_exam.plants.effects.base import Effect
from thermodrift_exam.plants.everyday import Everyday, Stated
from thermodrift_exam.plants.options import Options, stream
from thermodrift_exam.plants.simulation import ERROR_STEP_UM, ERRORS, GAP_STEPS
from thermodrift_exam.plants.structure import Plant, Source, exposures_W_per_K, gains_um_per_K, links_W_per_K

RPM_NMM_W = 1.047e-4
VISCOSITY_MM2_PER_S = 22.0
BEARINGS = {"front": (3, 77.5, 26000.0), "rear": (2, 70.0, 22000.0)}  # count, mean diameter mm, C0 N
HIGH = ("head", "motor", "rear", "column", "screw")  # bodies in the upper air of the hall


class _Pen:
    """Writes values as an engineer knows them."""

    def __init__(self, rng: np.random.Generator, options: Options) -> None:
        self.rng, self.options = rng, options

    def guess(self, value: float, error: float) -> float:
        return value * float(np.exp(error * self.rng.standard_normal()))

    def free(self, value: float, unit: str, spread: float | None = None) -> dict[str, Any]:
        """A positive parameter that the engineer has estimated."""
        error = self.options.file_error
        return {"value": f"{self.guess(value, error):.4g} {unit}".strip(), "spread": spread or max(error, 0.05)}

    def mass(self, value: float) -> dict[str, Any]:
        error = self.options.mass_error
        return {"value": f"{self.guess(value, error):.4g} J/K", "spread": max(error, 0.02)}

    def gain(self, value: float) -> dict[str, Any]:
        """A signed gain from a drawing's lengths."""
        stated = self.guess(value, self.options.mass_error)
        return {"value": f"{stated:.4g} um/K", "spread": f"{0.2 * abs(stated) + 0.02:.3g} um/K"}


def machine_file(
    plant: Plant, effects: Sequence[Effect], name: str, seed: int, options: Options, daily: Sequence[Everyday] = ()
) -> Machine:
    """The machine of a case with its twin part; what the effects withhold is not in it, what `daily` states is."""
    pen = _Pen(stream(seed, "file"), options)
    withheld = {e.withholds for e in effects if e.withholds}
    hidden = {"mandrel"} & withheld
    offset = {"value": "0 K", "spread": "0.2 K"}
    twin = {
        "surroundings": _surroundings(plant),
        "bodies": _bodies(plant, pen, hidden),
        "links": {
            f"{a}-{b}": pen.free(g, "W/K", 1.3 * max(options.file_error, 0.05))
            for (a, b), g in links_W_per_K(plant.structure).items()
            if not {a, b} & hidden
        },
        "exposures": {
            f"{body}-{_around(plant, body, around)}": pen.free(g, "W/K")
            for (body, around), g in exposures_W_per_K(plant.structure).items()
            if body not in hidden
        },
        "mechanisms": {k: _mechanism(k, s, plant, pen) for k, s in plant.sources.items() if k not in withheld}
        | {stated.name: _stated(stated, pen) for piece in daily if (stated := piece.stated())},
        "sensors": {
            s.channel: {"at": s.body, "lag": {"value": "45 s", "spread": 0.3}, "offset": offset}
            for s in plant.sensors
        },
        "errors": {c: _error(plant, c, pen, withheld) for c in ERRORS},
    }  # fmt: skip
    for effect in effects:
        for path, factor in effect.misread().items():
            _misread(twin, path, factor)
    return Machine(
        machine=name,
        description="Simulated machine drawn at random; no recording of a real one.",
        simulated=True,
        recording={  # type: ignore[arg-type]
            "files": ["*.csv"], "step_s": options.step_s, "max_gap_s": GAP_STEPS * options.step_s,
            "start_from_name": "%Y%m%d_%H%M",
        },
        channels=_channels(plant, options),  # type: ignore[arg-type]
        twin=twin,
    )  # fmt: skip


def _channels(plant: Plant, options: Options) -> dict[str, dict[str, Any]]:
    degC = {"unit": "degC", "resolution": options.quantisation_K, "range": [-20, 120]}
    out: dict[str, dict[str, Any]] = {s.channel: {"role": "temperature", **degC} for s in plant.sensors}
    out["room"] = {"role": "ambient", **degC}
    if "walls" in plant.features:
        out["wall"] = {"role": "ambient", **degC}
    out["spindle_rpm"] = {"role": "driver", "unit": "rpm", "resolution": 1}
    switch = {"role": "driver", "unit": "1", "resolution": 1}
    if "feed" in plant.features:
        out["feed"] = {"role": "driver", "unit": "mm/min", "resolution": 1}
    if "coolant" in plant.features:
        out["coolant"] = switch
    out |= {name: switch for name in options.idle}
    return out | {c: {"role": "error", "unit": "um", "resolution": ERROR_STEP_UM} for c in ERRORS}


def _surroundings(plant: Plant) -> dict[str, Any]:
    out: dict[str, Any] = {"room": {"channel": "room"}}
    if "layers" in plant.features:
        out["hall_top"] = {"channel": "room", "words": "air at the head and the upper column"}
    if "walls" in plant.features:
        out["walls"] = {"channel": "wall", "words": "walls of the hall"}
    return out


def _around(plant: Plant, body: str, around: str) -> str:
    upper = "layers" in plant.features and body.startswith(HIGH)
    return "hall_top" if around == "room" and upper else around


def _bodies(plant: Plant, pen: _Pen, hidden: set[str]) -> dict[str, Any]:
    s = plant.structure
    out: dict[str, Any] = {}
    for name, part in s.bodies.items():
        if name in hidden:
            continue
        capacity = pen.mass(part.capacity_J_per_K)
        casting = next((c for n, c in s.castings.items() if part.cells[0] in s.cells[n]), None)
        out[name] = {"capacity": capacity} | ({} if casting is None else {"material": casting.material})
    return out


def _mechanism(name: str, source: Source, plant: Plant, pen: _Pen) -> dict[str, Any]:
    """Watts at the rated speed in the terms of the law that a machine file states."""
    place = name.partition("_")[0]
    if source.law == "motor":
        watts = zip(("idle", "linear", "quadratic"), source.watts, strict=True)
        parameters: dict[str, Any] = {k: pen.free(w, "W") for k, w in watts}
        parameters["rated"] = f"{plant.rated_rpm:.0f} rpm"
        return {"law": "motor_loss", "drivers": "spindle_rpm", "into": "motor", "parameters": parameters}
    count, mean_mm, static_N = BEARINGS[place]
    per_Nmm = count * RPM_NMM_W * plant.rated_rpm  # watts of 1 N mm in every bearing
    parameters = {"count": count, "mean_diameter": f"{mean_mm} mm"}
    if source.law == "viscous":
        unit_Nmm = 1e-7 * (VISCOSITY_MM2_PER_S * plant.rated_rpm) ** (2.0 / 3.0) * mean_mm**3
        parameters["lubrication"] = pen.free(source.watts[0] / (per_Nmm * unit_Nmm), "")
        parameters["viscosity"] = f"{VISCOSITY_MM2_PER_S} mm**2/s"
    else:
        moment_Nmm = source.watts[0] / per_Nmm  # z (F / C0)^y F dm with z 0.001, y 0.33
        preload_N = (moment_Nmm * static_N**0.33 / (0.001 * mean_mm)) ** (1.0 / 1.33)
        parameters["preload"] = pen.free(preload_N, "N")
        parameters["static_capacity"] = f"{static_N} N"
    into = {"shaft": {"value": 0.5, "spread": 0.4}, place: "rest"}
    law = {"viscous": "bearing_viscous", "load": "bearing_load"}[source.law]
    return {"law": law, "drivers": "spindle_rpm", "into": into, "parameters": parameters}


def _stated(stated: Stated, pen: _Pen) -> dict[str, Any]:
    parameters = {name: pen.free(value, unit) for name, (value, unit) in stated.free.items()} | dict(stated.fixed)
    return {"law": stated.law, "drivers": stated.drivers, "into": stated.into, "parameters": parameters}


def _error(plant: Plant, channel: str, pen: _Pen, withheld: set[str]) -> dict[str, Any]:
    """Withheld features are left out: the file describes a machine without them."""
    chain, tilts = [], []
    for growth in plant.growths:
        if growth.channel != channel or growth.name in withheld:
            continue
        if growth.tilt is not None:
            gain = pen.gain(growth.lumped_um_per_K)
            tilts.append({"hot": growth.tilt[0], "cold": growth.tilt[1], "gain": gain, "words": growth.name})
            continue
        for body, total in gains_um_per_K(plant.structure, growth.weights_um_per_K).items():
            gain = pen.gain(total)
            chain.append({"body": body, "gain": gain, "words": growth.name})
    return {"noise": "1 um", "chain": chain, "tilts": tilts}


def _misread(twin: Mapping[str, Any], path: str, factor: float) -> None:
    """One value of the file times a factor."""
    *keys, last = path.split(".")
    at: Any = twin
    for key in keys:
        at = at[key]
    number, _, unit = at[last]["value"].partition(" ")
    at[last] = {**at[last], "value": f"{float(number) * factor:.4g} {unit}"}
