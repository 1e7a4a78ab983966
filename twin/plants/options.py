"""What may be asked of a case beside its seed and its effect."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Options:
    """Batches of `hours`, rows every `step_s`; the solver's step is `solver_s`, and it starts `before_h` earlier.

    `has` and `lacks` overrule the features that the seed gives (`twin.plants.machine.FEATURES`). `file_error` is the
    sd of the logarithm of what the engineer's values are off by, `mass_error` that of masses.
    """

    batches: int = 12
    step_s: float = 300.0
    hours: float = 6.0
    before_h: float = 10.0
    noise_K: float = 0.03
    noise_um: float = 0.8
    quantisation_K: float = 0.1
    missing: float = 0.0
    friction_scatter: float = 0.0
    file_error: float = 0.3
    mass_error: float = 0.1
    has: tuple[str, ...] = ()
    lacks: tuple[str, ...] = ()
    solver_s: float = 15.0
