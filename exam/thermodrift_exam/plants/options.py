"""Options of a case other than its seed and its effect, and the random streams of a seed."""

from __future__ import annotations

from dataclasses import dataclass
from zlib import crc32

import numpy as np

MAX_HOLE_S = 900.0  # longer ones leave a simulation without its inputs


@dataclass(frozen=True)
class Options:
    """Batches of `hours`, rows every `step_s`; the solver's step is `solver_s`, and it starts `before_h` earlier.

    `has` and `lacks` overrule the features that the seed gives (`plants.structure.FEATURES`). `file_error` is the
    sd of the logarithm of what the engineer's values are off by, `mass_error` that of masses. `spread` widens the
    ranges of the plants' sizes.

    Of the recorder: rows come up to `early_s` before they are due, `gaps` is how often a run has a hole of at most
    `MAX_HOLE_S`, `absent` the chance that a sensor is not there in a run, `missing` that a sample is lost. Of the shop:
    means of the room from `coldest_degC` to `warmest_degC`, starts from `earliest_h` to `latest_h`, `habit` a
    key of `plants.drawing.HABITS`; `idle` are recorded switches that drive nothing. `name` is the machine's.
    `everyday`: whether coefficients follow the temperatures (`plants.everyday`), which no answer names.
    """

    batches: int = 12
    step_s: float = 300.0
    hours: float = 6.0
    before_h: float = 10.0
    noise_K: float = 0.03
    noise_um: float = 0.8
    quantisation_K: float = 0.1
    missing: float = 0.0
    early_s: float = 0.0
    gaps: float = 0.0
    absent: float = 0.0
    coldest_degC: float = 12.0
    warmest_degC: float = 28.0
    earliest_h: float = 6.5
    latest_h: float = 14.0
    habit: str = "ordinary"
    idle: tuple[str, ...] = ()
    name: str = ""
    friction_scatter: float = 0.0
    everyday: bool = False
    file_error: float = 0.3
    mass_error: float = 0.1
    spread: float = 1.0
    has: tuple[str, ...] = ()
    lacks: tuple[str, ...] = ()
    solver_s: float = 15.0


Range = tuple[float, float]


def stream(seed: int, name: str) -> np.random.Generator:
    """The generator of a part ("geometry", "runs", …) of the case of a seed."""
    return np.random.default_rng([seed, crc32(name.encode())])


def wider(limits: Range, spread: float) -> Range:
    """The range of a positive quantity made `spread` times as wide, by logarithm about its own middle."""
    low, high = limits
    if spread == 1.0:
        return limits
    middle, half = float(np.sqrt(low * high)), float(np.log(high / low)) / 2.0 * spread
    return middle * float(np.exp(-half)), middle * float(np.exp(half))
