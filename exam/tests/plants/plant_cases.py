"""Small noiseless cases, and the same machine and runs with an effect and without it."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from data.arrays import Array
from thermodrift_exam.plants.drawing import draw_plant
from thermodrift_exam.plants.effects import EFFECTS
from thermodrift_exam.plants.plant import Case, draw
from thermodrift_exam.plants.runs import Now
from thermodrift_exam.plants.structure import Plant

QUIET: dict[str, Any] = {
    "batches": 4, "hours": 4.0, "before_h": 5.0, "solver_s": 50.0,
    "noise_K": 0.0, "noise_um": 0.0, "quantisation_K": 1e-6,
}  # fmt: skip
SEED = 3
NONE: frozenset[str] = frozenset()


@cache
def quiet(effect: str | None, size: float, has: tuple[str, ...] = (), lacks: tuple[str, ...] = ()) -> Case:
    return draw(SEED, effect, size, has=has, lacks=lacks, **QUIET)


@cache
def brief(effect: str | None, size: float, has: tuple[str, ...] = (), lacks: tuple[str, ...] = ()) -> Case:
    """Two short batches, for what only has to be the same."""
    return draw(SEED, effect, size, batches=2, has=has, lacks=lacks, hours=1.0, before_h=1.0, solver_s=50.0)


def plant(seed: int = SEED, *has: str) -> Plant:
    return draw_plant(seed, frozenset(has), NONE)


def with_and_without(key: str) -> tuple[Case, Case]:
    """The same machine and runs with the effect at size 1 and at 0."""
    has = tuple(sorted(EFFECTS[key].has))
    return quiet(key, 1.0, has), quiet(key, 0.0, has)


def moved(key: str, channel: str) -> Array:
    """What the effect adds to a channel, (batches, rows)."""
    one, other = with_and_without(key)
    return np.stack([a.values(channel) - b.values(channel) for a, b in zip(one.batches, other.batches, strict=True)])


def driver(key: str, name: str) -> Array:
    """A driver of the same batches, (batches, rows)."""
    return np.stack([b.values(name) for b in with_and_without(key)[0].batches])


def full_speed(p: Plant) -> Now:
    """One batch at the rated speed in a room of 20 degC, at noon."""
    one = np.ones(1)
    return Now(0.0, p.rated_rpm * one, 0 * one, 0 * one, 20 * one, 20 * one, 20 * one, 12 * one)
