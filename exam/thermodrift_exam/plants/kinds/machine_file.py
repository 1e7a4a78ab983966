"""The machine file that an engineer would write of a plant of any kind: lumped, inexact, without the effects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np

from data.machine import Machine
from thermodrift_exam.plants.kinds.plant import KindPlant, Stated, exposures_W_per_K, gains_um_per_K, links_W_per_K
from thermodrift_exam.plants.kinds.simulation import GAP_ROWS, noise_of
from thermodrift_exam.plants.options import stream

NOTHING: Mapping[str, float] = MappingProxyType({})


class Pen:
    """Writes values as an engineer knows them: off by a log-normal factor, with a prior that admits it."""

    def __init__(self, rng: np.random.Generator, plant: KindPlant) -> None:
        self.rng, self.s = rng, plant.setting

    def guess(self, value: float, error: float) -> float:
        return value * float(np.exp(error * self.rng.standard_normal()))

    def free(self, value: float, unit: str, wider: float = 1.0) -> dict[str, Any]:
        error = self.s.file_error
        return {"value": f"{self.guess(value, error):.4g} {unit}".strip(), "spread": round(wider * error, 3)}

    def mass(self, value: float) -> dict[str, Any]:
        return {"value": f"{self.guess(value, self.s.mass_error):.4g} J/K", "spread": round(self.s.mass_error, 3)}

    def signed(self, value: float, unit: str, sd: float) -> dict[str, Any]:
        return {"value": f"{value + sd * self.rng.standard_normal():.4g} {unit}", "spread": f"{sd:.3g} {unit}"}

    def gain(self, value: float, unit: str) -> dict[str, Any]:
        """A signed gain from a drawing's lengths."""
        stated = self.guess(value, self.s.mass_error)
        return {"value": f"{stated:.4g} {unit}", "spread": f"{1.5 * self.s.mass_error * abs(stated) + 0.02:.3g} {unit}"}


def machine_file(
    plant: KindPlant, full: KindPlant, name: str, seed: int, idle: Sequence[str] = (),
    misread: Mapping[str, float] = NOTHING,
) -> Machine:  # fmt: skip
    """The machine of a case with its twin part. `plant` is `full` without the withheld features of the effects.

    The values of what both have are the same whatever the effects are: they are drawn for the full plant. `misread`
    multiplies the conductances of links.
    """
    twin = _twin(full, Pen(stream(seed, "kind file"), full))
    for source in full.sources.keys() - plant.sources.keys():
        for stated in full.sources[source].stated:
            del twin["mechanisms"][stated]
    twin["errors"] = {c: _error(plant, full, c, seed) for c in plant.errors}
    for link, factor in misread.items():
        number, _, unit = twin["links"][link]["value"].partition(" ")
        twin["links"][link]["value"] = f"{float(number) * factor:.4g} {unit}"
    return Machine(
        machine=name,
        description="Simulated machine drawn at random; no recording of a real one.",
        simulated=True,
        recording={  # type: ignore[arg-type]
            "files": ["*.csv"], "step_s": plant.setting.row_s, "max_gap_s": GAP_ROWS * plant.setting.row_s,
            "start_from_name": "%Y%m%d_%H%M",
        },
        channels=_channels(plant, idle),  # type: ignore[arg-type]
        twin={k: v for k, v in twin.items() if v},
    )  # fmt: skip


def _channels(plant: KindPlant, idle: Sequence[str]) -> dict[str, dict[str, Any]]:
    s = plant.setting
    fine = {"resolution": s.step_K} if s.step_K else {}
    degC = {"unit": "degC", "range": [-30, 200], **fine}
    out: dict[str, dict[str, Any]] = {x.channel: {"role": "temperature", **degC} for x in plant.sensors}
    out |= {air: {"role": "ambient", **degC} for air in plant.airs}
    for name, d in plant.drivers.items():
        out[name] = {"role": "driver", "unit": d.unit, "range": [d.low, d.high]}
        if d.resolution:
            out[name]["resolution"] = d.resolution
    out |= {name: {"role": "driver", "unit": "1", "resolution": 1} for name in idle}
    stepped = {"resolution": s.step_um} if s.step_um else {}
    return out | {c: {"role": "error", "unit": plant.error_unit, **stepped} for c in plant.errors}


def _twin(plant: KindPlant, pen: Pen) -> dict[str, Any]:
    bodies: dict[str, Any] = {}
    for name, cells in plant.bodies.items():
        bodies[name] = {"capacity": pen.mass(float(plant.solid.capacity_J_per_K[cells].sum()))}
    links = {f"{a}-{b}": pen.free(g, "W/K", 1.3) for (a, b), g in links_W_per_K(plant).items()}
    exposures = {f"{b}-{air}": pen.free(g, "W/K") for (b, air), g in exposures_W_per_K(plant).items()}
    mechanisms = {k: _mechanism(s, pen) for source in plant.sources.values() for k, s in source.stated.items()}
    return {
        "surroundings": {air: {"channel": air} for air in plant.airs},
        "bodies": bodies, "links": links, "exposures": exposures, "mechanisms": mechanisms,
        "sensors": _sensors(plant, pen), "initial_spread": f"{max(0.5, plant.setting.slow_K):.2g} K",
    }  # fmt: skip


def _sensors(plant: KindPlant, pen: Pen) -> dict[str, Any]:
    s = plant.setting
    sd = max(noise_of(plant, plant.sensors[0].channel) * pen.guess(1.0, 0.2), 0.005)
    out = {}
    for sensor in plant.sensors:
        entry: dict[str, Any] = {"at": sensor.body, "noise": f"{sd:.2g} K"}
        if s.states_lags:
            entry["lag"] = {"value": f"{s.sensor_lag_s:.3g} s", "spread": 0.4}
        if s.states_offsets:
            entry["offset"] = {"value": "0 K", "spread": "0.2 K"}
        out[sensor.channel] = entry
    return out


def _mechanism(stated: Stated, pen: Pen) -> dict[str, Any]:
    *first, last = stated.into
    shares = {b: {"value": round(min(max(stated.into[b], 0.05), 0.95), 2), "spread": 0.5} for b in first}
    into: Any = {**shares, last: "rest"} if first else last
    parameters: dict[str, Any] = {name: pen.free(v, unit, 1.2) for name, (v, unit) in stated.free.items()}
    parameters |= {name: pen.signed(v, unit, sd) for name, (v, unit, sd) in stated.signed.items()}
    parameters |= dict(stated.fixed)
    more = {"at": dict(stated.at)} if stated.at else {}
    return {"law": stated.law, "drivers": stated.drivers, "into": into, "parameters": parameters, **more}


def _error(plant: KindPlant, full: KindPlant, channel: str, seed: int) -> dict[str, Any]:
    """Chains of gains; withheld ones are left out."""
    chain, tilts = [], []
    unit = f"{plant.error_unit}/K"
    for name, growth in plant.growths.items():
        if growth.channel != channel:
            continue
        pen = Pen(stream(seed, f"kind file {name}"), full)
        if growth.tilt is not None:
            hot, cold = growth.tilt
            tilts.append({"hot": hot, "cold": cold, "gain": pen.gain(growth.lumped_um_per_K, unit), "words": name})
            continue
        for body, total in gains_um_per_K(plant, growth).items():
            chain.append({"body": body, "gain": pen.gain(total, unit), "words": name})
    rng = stream(seed, f"kind noise {channel}")
    noise = max(noise_of(plant, channel) * float(np.exp(0.2 * rng.standard_normal())), 0.01)
    return {"noise": f"{noise:.2g} {plant.error_unit}", "chain": chain, "tilts": tilts}
