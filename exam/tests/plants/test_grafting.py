"""The response of a grafted heat: energy, the closed form of one body, linearity, and what reaches the channels."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import pytest

from data.batch import Batch, Channel
from data.errors import InputError
from data.machine import Machine
from thermodrift_exam.plants.grafted.base import Setting, magnitude
from thermodrift_exam.plants.grafted.faults import SensorBonding, SensorDrift, SensorLag, TimeSkew
from thermodrift_exam.plants.grafted.frame import Clockwork, Frame, Push, draw_frame, on_channels, response
from thermodrift_exam.plants.grafted.heats import CabinetHeat, FloorSink, HydraulicUnit, Sun
from thermodrift_exam.plants.real import windows

TWIN: dict[str, Any] = {
    "surroundings": {"room": {"channel": "room", "offset": "1 K"}},
    "bodies": {"bed": {"capacity": "200 kJ/K"}, "column": {"capacity": {"value": "100 kJ/K", "spread": 0.3}}},
    "links": {"bed-column": "40 W/K"},
    "exposures": {"bed-room": {"value": "20 W/K", "spread": 0.5}, "column-room": "10 W/K"},
    "sensors": {"t_bed": {"at": "bed"}, "t_column": {"at": "column", "bonding": {"value": 0.9, "spread": 0.5}}},
    "errors": {"z": {"chain": [{"body": "column", "gain": {"value": "-5 um/K", "spread": "1 um/K"}}]}},
}
ROWS, STEP_S = 181, 60.0


def machine() -> Machine:
    parts = {
        "t_bed": {"role": "temperature", "unit": "degC", "resolution": 0.1},
        "t_column": {"role": "temperature", "unit": "degC", "resolution": 0.1},
        "room": {"role": "ambient", "unit": "degC"},
        "z": {"role": "error", "unit": "um"},
    }
    return Machine(machine="two_bodies", channels=parts, twin=TWIN)  # type: ignore[arg-type]


def run(name: str, start: str, rows: int = ROWS) -> Batch:
    """A warm machine in a cooler room: the bed at 26 degC, the column rising, the probe along a straight line."""
    time_s = STEP_S * np.arange(rows)
    table = {
        "time_s": time_s, "t_bed": np.full(rows, 26.0), "t_column": 24.0 + time_s / 3600.0,
        "room": np.full(rows, 22.0), "z": 2.0 * time_s / 3600.0,
    }  # fmt: skip
    channels = {n: Channel(n, c.role, c.unit, c.resolution) for n, c in machine().channels.items()}
    return Batch("two_bodies", name, pd.DataFrame(table), channels, start=pd.Timestamp(start))


@pytest.fixture(scope="module")
def setting() -> Setting:
    return Setting(machine(), [run("a", "2020-01-01 07:00"), run("b", "2020-01-02 11:00", 121)], 5)


@pytest.fixture(scope="module")
def frame() -> Frame:
    return draw_frame(TWIN, np.random.default_rng(1))


def steady(watts: float, clock: Clockwork) -> Push:
    return Push({"bed": np.full((clock.steps, 1), watts)})


def test_what_a_file_says_is_read_with_its_unit() -> None:
    assert magnitude({"value": "537 kJ/K", "spread": 0.5}, "x") == 537e3
    assert magnitude("3 mW/K", "x") == pytest.approx(3e-3) and magnitude(0.94, "x") == 0.94
    with pytest.raises(InputError, match=r"grafted: links.a-b: unit 'W/mK' is not known here; did you mean 'W/K'\?"):
        magnitude("5 W/mK", "links.a-b")
    with pytest.raises(InputError, match=r"grafted: bodies.bed: got 'heavy', expected a number with a unit"):
        magnitude("heavy", "bodies.bed")


def test_the_frame_keeps_the_file_s_sums_within_its_scatter(frame: Frame) -> None:
    assert frame.capacity_J_per_K.sum() == pytest.approx(300e3, rel=0.5)
    to_room = np.asarray(frame.losses.sum(axis=1)).ravel()
    assert to_room.sum() == pytest.approx(sum(frame.room_W_per_K.values()))
    assert np.abs((frame.losses - frame.losses.T).toarray()).max() == 0
    assert sum(frame.room_W_per_K.values()) != pytest.approx(30.0, rel=1e-3)


def test_steady_heat_ends_where_all_of_it_leaves_to_the_room(frame: Frame) -> None:
    clock = Clockwork(3600.0, 400, 800)
    rise = response(frame, steady(90.0, clock), clock)[-1, :, 0]
    assert (frame.losses @ rise).sum() == pytest.approx(90.0, rel=1e-3)


def test_before_anything_leaves_all_heat_is_stored(frame: Frame) -> None:
    clock = Clockwork(1.0, 0, 5)
    rise = response(frame, steady(90.0, clock), clock)[-1, :, 0]
    assert frame.capacity_J_per_K @ rise == pytest.approx(90.0 * 5.0, rel=1e-3)


def test_one_body_alone_answers_as_the_closed_form() -> None:
    alone = TWIN | {"bodies": {"bed": {"capacity": "200 kJ/K"}}, "links": {}, "sensors": {}, "errors": {},
                    "exposures": {"bed-room": "20 W/K"}}  # fmt: skip
    own = draw_frame(alone, np.random.default_rng(3))
    clock = Clockwork(60.0, 0, 300)
    push = Push({"bed": np.full((300, 1), 50.0)}, spread=True)
    mean = response(own, push, clock).mean(axis=1)[:, 0]
    conductance, tau_s = own.room_W_per_K["bed"], own.capacity_J_per_K.sum() / own.room_W_per_K["bed"]
    assert mean == pytest.approx(50.0 / conductance * (1 - np.exp(-60.0 * np.arange(301) / tau_s)), abs=1e-4)


def test_a_loss_that_grows_with_the_rise_is_a_conductance_more(frame: Frame) -> None:
    clock = Clockwork(3600.0, 0, 900)
    push = Push(steady(90.0, clock).drive_W, {"bed": np.full((clock.steps, 1), 60.0)})
    rise = response(frame, push, clock)[-1, :, 0]
    assert (frame.losses @ rise).sum() == pytest.approx(90.0 - 60.0 * rise[frame.spots["bed"]], rel=1e-3)


def test_channels_show_cells_by_bonding_and_errors_count_from_the_start(frame: Frame) -> None:
    rise = np.arange(2.0 * frame.size).reshape(2, frame.size, 1)
    shown = on_channels(frame, rise)
    seat = frame.placements["t_column"]
    assert shown["t_column"] == pytest.approx(0.9 * rise[:, seat.cell])
    gain = frame.gains_um_per_K["z"]["column"]
    assert shown["z"][:, 0] == pytest.approx([0.0, gain * frame.size]) and -8.0 < gain < -3.0


def test_a_heat_is_as_strong_as_its_size_says(setting: Setting) -> None:
    for size in (0.5, 2.0):
        graft = CabinetHeat(setting, size, np.random.default_rng(2))
        changes = [
            np.abs(graft.shown(k, b)[f"t_{graft.body}"] - b.values(f"t_{graft.body}")).max()
            for k, b in enumerate(setting.batches)
        ]
        assert max(changes) == pytest.approx(1.5 * size, rel=1e-6)


def test_a_cool_ground_draws_heat_and_less_of_it_the_cooler_the_bed(setting: Setting) -> None:
    """The bed is at 26 degC, the ground at 18 + 0.5 (22 - 18) = 20."""
    graft = FloorSink(setting, 1.0, np.random.default_rng(2))
    assert graft.body == "bed"
    change = graft.shown(0, setting.batches[0])["t_bed"] - 26.0
    assert (change[1:] < 0).all() and -1.5 < change.min() < -0.5
    assert graft.unit_push().drive_W["bed"] == pytest.approx(np.full((graft.clock.steps, 2), -6.0))


def test_the_sun_shines_by_the_clock_and_not_by_the_run(setting: Setting) -> None:
    graft = Sun(setting, 1.0, np.random.default_rng(4))
    hours = [(b.start.hour + b.time_s / 3600.0) for b in setting.batches if b.start is not None]
    for batch, clock_h in zip(setting.batches, hours, strict=True):
        shines = graft.acting(batch)
        assert np.array_equal(shines, (clock_h > graft.rise_h) & (clock_h < graft.set_h))
    assert {w[0] for w in graft.term().active} == {"a", "b"}


def test_a_cycling_pump_runs_for_its_share_of_each_period(setting: Setting) -> None:
    class Here(HydraulicUnit):
        bodies = ("bed", "column")

    graft = Here(setting, 1.0, np.random.default_rng(4))
    on = graft.unit_push().drive_W[graft.body][graft.clock.before :, 0]
    whole = int(graft.period_min)  # rows of a minute
    assert on[:whole].mean() == pytest.approx(graft.duty, abs=1.0 / whole)
    assert np.array_equal(on[:whole], on[whole : 2 * whole]) and not graft.unit_push().drive_W[graft.body][0].any()


def test_faults_of_a_sensor_do_what_their_equations_say(setting: Setting) -> None:
    batch = setting.batches[0]
    drift = SensorDrift(setting, 2.0, np.random.default_rng(1))
    (channel, shown), = drift.shown(0, batch).items()  # fmt: skip
    assert shown - batch.values(channel) == pytest.approx(drift.rate_K_per_h * batch.time_s / 3600.0)
    lag = SensorLag(setting, 1.0, np.random.default_rng(1))
    lag.channel = "t_column"  # rises by 1 K/h: in the end 600 s late
    assert (batch.values("t_column") - lag.shown(0, batch)["t_column"])[-1] == pytest.approx(1.0 / 6.0, abs=0.01)
    bonding = SensorBonding(setting, 1.0, np.random.default_rng(1))
    assert bonding.channel == "t_bed"  # the other has a share already
    assert bonding.shown(0, batch)["t_bed"] == pytest.approx(np.full(ROWS, 23.0 + 0.85 * 3.0))


def test_a_clock_that_is_ahead_shows_what_comes_and_nothing_beyond_the_end(setting: Setting) -> None:
    batch = setting.batches[0]
    skew = TimeSkew(setting, 1.0, np.random.default_rng(1))
    for skew.delay_s in (300.0, -300.0):
        shown = skew.shown(0, batch)["z"]
        expected = 2.0 * np.clip(batch.time_s + skew.delay_s, 0.0, None) / 3600.0
        known = np.isfinite(shown)
        assert shown[known] == pytest.approx(expected[known])
        assert (~known).sum() == (5 if skew.delay_s > 0 else 0)


def test_windows_end_where_the_next_row_begins(setting: Setting) -> None:
    batch = setting.batches[1]
    mask = (batch.time_s >= 600.0) & (batch.time_s < 1200.0)
    assert windows([batch], [mask]) == [["b", 600.0, 1200.0]]
    assert windows([batch], [np.ones(batch.n_rows, bool)]) == [["b", 0.0, batch.time_s[-1]]]
