"""The state machine as a program: one step for several values at once, by the runner and by numbers."""

from __future__ import annotations

import numpy as np
import pytest

from compensation import core
from compensation.safety import Limits

LIMITS = Limits(max_offset_um=20.0, rate_um_per_s=0.5, step_um=2.0, hold_s=10.0, stale_s=5.0, warm_up_s=4.0)


def hostile(n: int, seed: int) -> np.ndarray:
    """Rows (n, inputs) with limits: runs of good seconds, silence, faults and stops; pauses and clock steps."""
    rng = np.random.default_rng(seed)
    kind = np.repeat(rng.choice(["good", "good", "good", "silent", "faulty", "stopped"], n), rng.integers(1, 30, n))[:n]
    elapsed_s = rng.choice(
        [1.0, 1.0, 1.0, 0.0, 0.1, 7.0, -3.0, 1e12], n, p=[0.3, 0.3, 0.2, 0.05, 0.05, 0.05, 0.03, 0.02]
    )
    wanted_um = rng.choice([10.0, -4.0, 1e300, 0.0], n) + rng.normal(size=n)
    flags = [(kind == "good") | (kind == "stopped"), kind == "faulty", kind == "stopped"]
    limits = [getattr(LIMITS, name) for name in core.LIMITS]
    return np.column_stack([elapsed_s, wanted_um, *flags, np.tile(limits, (n, 1))])


@pytest.mark.parametrize("seed", range(3))
def test_the_runner_and_the_step_of_one_value_agree_for_several_values(seed: int) -> None:
    values = [hostile(2000, 10 * seed + k) for k in range(3)]
    program = core.core(3)
    run, state = program.runner(), program.begin()
    carried = [tuple(core.CARRIED.values()) for _ in values]
    states = set()
    for rows in zip(*values, strict=True):
        got = run(state, np.column_stack(rows).ravel()).reshape(len(core.CARRIED), 3)
        carried = [core.run()(row.tolist(), *was) for row, was in zip(rows, carried, strict=True)]
        assert np.array_equal(got, np.transpose(carried))
        states |= set(got[0])
    assert states == {core.OFF, core.WARM_UP, core.ACTIVE, core.HOLD, core.FADE_OUT}


def test_a_step_is_bounded_whatever_arrives() -> None:
    carried, before = tuple(core.CARRIED.values()), 0.0
    for row in hostile(5000, 7):
        carried = core.run()(row.tolist(), *carried)
        reach = min(LIMITS.rate_um_per_s * min(max(row[0], 0.0), LIMITS.stale_s), LIMITS.step_um)
        assert abs(carried[1] - before) <= reach + 1e-12 and abs(carried[1]) <= LIMITS.max_offset_um
        before = carried[1]
