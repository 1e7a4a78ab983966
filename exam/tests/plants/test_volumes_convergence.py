"""The finite volumes on finer grids: the same machine, the same joints, and errors of the order that they claim."""

from __future__ import annotations

import numpy as np
import pytest

from tests.plants.plant_cases import NONE
from thermodrift_exam.plants.convergence import COLUMNS, volumes_study
from thermodrift_exam.plants.drawing import draw_plant
from thermodrift_exam.plants.structure import exposures_W_per_K
from thermodrift_exam.plants.volumes.structure import Assembly, Plate


@pytest.mark.parametrize("seed", [3, 5])
def test_a_finer_grid_is_the_same_machine(seed: int) -> None:
    has = frozenset({"growth", "bending", "mandrel"})
    plain, fine = (draw_plant(seed, has, NONE, finer=n) for n in (1, 2))
    a, b = plain.structure, fine.structure
    assert b.size > 3.8 * a.size
    assert b.capacity_J_per_K.sum() == pytest.approx(a.capacity_J_per_K.sum())
    assert b.room_W_per_K.sum() == pytest.approx(a.room_W_per_K.sum())
    assert b.air_W_per_K.sum() == pytest.approx(a.air_W_per_K.sum())
    assert b.touching() == a.touching()
    assert exposures_W_per_K(b) == pytest.approx(exposures_W_per_K(a))
    for one, other in zip(plain.growths, fine.growths, strict=True):
        assert other.weights_um_per_K.sum() == pytest.approx(one.weights_um_per_K.sum(), abs=1e-9)


def test_a_joint_stays_where_it_is_and_as_good_as_it_is() -> None:
    """Between the blocks' means flows G per kelvin, however finely they are cut."""
    for split in (1, 3):
        a = Assembly()
        for name in ("one", "other"):
            a.add(Plate(name, "steel", 10.0, 0.4, 0.1, 0.1, (4, 1), 0.0, split=split))
        a.joint(a.box("one", (0.5, 1.0)), a.box("other", (0.0, 0.5)), 12.0)
        s = a.done(0.0)
        cells = np.zeros(s.size)
        cells[s.cells["one"][s.castings["one"].box((0.5, 1.0))]] = 1.0
        lost = s.losses() @ cells
        assert lost[s.cells["other"]].sum() == pytest.approx(-12.0)
        assert np.flatnonzero(lost[s.cells["other"]]).tolist() == s.castings["other"].box((0.0, 0.5)).tolist()


def test_errors_fall_with_the_square_of_cell_and_step() -> None:
    table = volumes_study(grids=(1, 2), steps_s=(60.0, 30.0))
    assert tuple(table.columns) == COLUMNS
    assert table["order"].isna().sum() == 4
    orders = table.dropna()
    assert orders["order"].between(1.7, 2.4).all(), orders
    errors = table.groupby("refined")["error"].max()
    assert errors["step"] < 0.05 * errors["grid"]
    assert table[table["quantity"].str.endswith("um")]["error"].max() < 1.5
