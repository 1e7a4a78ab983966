"""Twin and plants mean the same by a row: what it shows of the drivers holds from there on."""

from __future__ import annotations

import numpy as np

from data.batch import Batch
from tests.diagnosis.small_cases import SHIFT, four_bodies, runs
from thermodrift_exam.plants.plant import draw
from twin.simulation.inputs import intervals_at_rows


def jumps(batch: Batch, speed: str) -> tuple[np.ndarray, np.ndarray]:
    """Rows in which the speed is another than before by half of its range, and in which the error jumps."""
    rpm, z_um = batch.values(speed), batch.values("z")
    rows = np.flatnonzero(np.abs(np.diff(rpm)) > 0.5 * np.ptp(rpm)) + 1
    far = np.abs(np.diff(z_um, prepend=z_um[:1]))
    return rows, np.flatnonzero(far > 0.2 * np.nanmax(far))


def test_a_shaft_that_moves_with_the_speed_has_moved_in_the_row_that_shows_it() -> None:
    shift = {**SHIFT, "parameters": {"shift": "150 um"}}
    twins = [(b, "rpm") for b in runs(four_bodies(), {"shift": shift}, count=3)]
    still = {"noise_um": 0.0, "missing": 0.0, "gaps": 0.0, "absent": 0.0, "early_s": 0.0}
    plants = [
        (b, "spindle_rpm")
        for plant in ("elements", "volumes")
        for b in draw(11, "speed_shift", 30.0, batches=2, plant=plant, hours=3.0, **still).batches
    ]
    told = 0
    for batch, speed in [*twins, *plants]:
        changed, jumped = jumps(batch, speed)
        assert set(changed) <= set(jumped), batch.batch_id
        told += len(changed)
    assert told >= 5


def test_the_last_row_has_no_interval_of_its_own() -> None:
    assert intervals_at_rows(6, 2).tolist() == [0, 2, 4, 5]
    assert intervals_at_rows(3, 1).tolist() == [0, 1, 2, 2]
