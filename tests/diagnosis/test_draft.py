"""A drafted network: as many bodies as there are, values right but for the scale, and a file that works like any."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml

from data.batch import Batch
from data.errors import InputError
from data.machine import Machine, load_machine
from data.recording import read_batches
from diagnosis.drafting.draft import Drafted, drafted_part
from diagnosis.drafting.first_guess import Balance, guess, valid_names
from plants.sample.sample_year import write_sample_year
from tests.twin.machines import machine
from tests.twin.recordings import empty_batches, recorded
from twin.calibration import calibrate
from twin.compile import compile_network
from twin.schema import TwinPart

ROOT = Path(__file__).parents[2]
# The file's belt makes 120 W at 6000 rpm; the recordings reach 5000, where the draft holds 300 W.
SCALE = 300.0 / (120.0 * (5.0 / 6.0) ** 1.5)
TRUE = {
    "bodies.t_shaft.capacity": 5e3, "bodies.t_head.capacity": 40e3, "links.t_shaft-t_head.conductance": 12.0,
    "exposures.t_head-room.conductance": 8.0,
}  # fmt: skip


@pytest.fixture(scope="module")
def given() -> Machine:
    return machine()


@pytest.fixture(scope="module")
def batches(given: Machine) -> list[Batch]:
    return recorded(given, empty_batches(given, 6))


@pytest.fixture(scope="module")
def drafted(given: Machine, batches: list[Batch]) -> Drafted:
    return drafted_part(without_twin(given), batches)


def without_twin(given: Machine) -> Machine:
    return given.model_copy(update={"twin": None})


def changed(given: Machine, **channels: dict[str, Any] | None) -> Machine:
    """Without a twin, some channels given other keys or (None) taken out."""
    raw = given.model_dump()
    raw["twin"] = None
    for name, keys in channels.items():
        if keys is None:
            del raw["channels"][name]
        else:
            raw["channels"][name] |= keys
    return Machine.model_validate(raw)


def with_tables(batches: Sequence[Batch], change: Callable[[pd.DataFrame], pd.DataFrame]) -> list[Batch]:
    return [replace(b, table=change(b.table.copy())) for b in batches]


def values_of(given: Machine, part: TwinPart) -> dict[str, float]:
    return {p.name: p.value for p in compile_network(given, part=part).parameters}


def by(table: pd.DataFrame, key: str, column: str) -> dict[Any, float]:
    return dict(zip(table[key].tolist(), table[column].astype(float).tolist(), strict=True))


def text_of(given: Machine, part: TwinPart) -> str:
    twin = part.model_dump(mode="json", exclude_defaults=True)
    raw = given.model_copy(update={"twin": twin}).model_dump(mode="json", exclude_defaults=True)
    return yaml.safe_dump(raw, sort_keys=False)


def test_two_bodies_are_found_as_two(given: Machine, drafted: Drafted) -> None:
    part = drafted.part
    assert list(part.bodies) == ["t_shaft", "t_head"]
    assert {n: s.at for n, s in part.sensors.items()} == {"t_shaft": "t_shaft", "t_head": "t_head"}
    assert list(part.links) == ["t_shaft-t_head"] and set(part.exposures) == {"t_shaft-room", "t_head-room"}
    (heat,) = part.mechanisms.values()
    assert heat.law == "belt_loss" and isinstance(heat.into, dict) and heat.into["t_shaft"] == "rest"


def test_values_are_right_but_for_the_scale_that_is_held(given: Machine, drafted: Drafted) -> None:
    got = values_of(given, drafted.part)
    for name, value in TRUE.items():
        assert got[name] == pytest.approx(SCALE * value, rel=0.1), name
    by_name = {p.name: p for p in compile_network(given, part=drafted.part).parameters}
    assert by_name["mechanisms.heat_of_rpm.power"].value == 300.0 and not by_name["mechanisms.heat_of_rpm.power"].free
    assert all(by_name[n].free and by_name[n].spread == 1.0 for n in TRUE)


def test_it_is_said_that_values_are_relative(drafted: Drafted) -> None:
    assert drafted.remarks[0].startswith(
        "the machine file has no twin part: 2 bodies drafted from 6 batches, named after"
    )
    assert drafted.remarks[1] == (
        "temperatures determine only ratios: heat_of_rpm is held at 300 W at 5000 rpm, "
        "and every other W, W/K and J/K is relative to that"
    )
    assert "all other W, W/K and J/K are relative to it" in drafted.part.mechanisms["heat_of_rpm"].words


def test_left_out_errors_come_down_to_the_noise(drafted: Drafted) -> None:
    left, zero, noise = (by(drafted.left_out, "channel", c) for c in ("left_out", "zero", "noise"))
    assert list(left) == ["t_shaft", "t_head", "z"]
    assert all(left[c] < 2.0 * noise[c] and left[c] < 0.05 * zero[c] for c in left)
    assert drafted.scores["chosen"].tolist() == [False, True]
    share = by(drafted.scores, "bodies", "share_left")
    assert share[1] > 10 * share[2]


def test_two_sensors_on_one_body_are_one_body(given: Machine) -> None:
    one = machine(
        sensors__t_head__at="shaft", bodies__head=None, links=None, exposures={"shaft-room": "3 W/K"},
        errors__z__chain=[{"body": "shaft", "gain": "3 um/K"}],
    )  # fmt: skip
    found = drafted_part(without_twin(given), recorded(one, empty_batches(one, 6), seed=3))
    assert len(found.part.bodies) == 1
    (body,) = found.part.bodies.values()
    assert body.words == "drafted: where t_shaft, t_head sit"


def test_the_twin_part_is_not_read_and_the_order_does_not_matter(
    given: Machine, batches: list[Batch], drafted: Drafted
) -> None:
    assert drafted_part(given, batches[::-1]).part == drafted.part


def test_it_survives_as_a_file_that_can_be_calibrated(
    given: Machine, batches: list[Batch], drafted: Drafted, tmp_path: Path
) -> None:
    path = tmp_path / "drafted.yml"
    path.write_text(text_of(given, drafted.part), encoding="utf-8")
    again = load_machine(path)
    assert values_of(again, TwinPart.model_validate(again.twin)) == values_of(given, drafted.part)
    done = calibrate(again, batches)
    assert done.fit.converged
    rms = {c: float(t["after"].mean()) for c, t in done.rms.groupby("channel")}
    assert rms["t_shaft"] < 0.05 and rms["t_head"] < 0.05 and rms["z"] < 0.6


def test_the_sample_year_needs_more_than_two_bodies(tmp_path: Path) -> None:
    year = without_twin(load_machine(ROOT / "machines" / "sample_vmc.yml"))
    runs = [b for f in write_sample_year(tmp_path, batches=8) for b in read_batches(f, year)]
    found = drafted_part(year, runs, max_bodies=3)
    assert len(found.part.bodies) == 3
    assert set(found.part.sensors) == set(year.names("temperature")) and set(found.part.errors) == {"x", "y", "z"}
    left, zero = (by(found.left_out, "channel", c) for c in ("left_out", "zero"))
    assert all(left[c] < zero[c] for c in left)
    assert min(by(found.scores, "bodies", "share_left").values()) < 0.3
    into = found.part.mechanisms["heat_of_spindle_rpm"].into
    warmest = into if isinstance(into, str) else next(k for k, v in (into or {}).items() if v == "rest")
    assert {"front", "rear", "motor"} & {n for n, sensor in found.part.sensors.items() if sensor.at == warmest}


@pytest.mark.parametrize(
    ("count", "blocks", "told"),
    [
        (1, 4, "1 batch alone: cut into 4 blocks each, and blocks were left out instead of batches"),
        (3, 6, "3 batches alone: cut into 2 blocks each, and blocks were left out instead of batches"),
    ],
)
def test_few_batches_are_cut_into_blocks(
    given: Machine, batches: list[Batch], count: int, blocks: int, told: str
) -> None:
    found = drafted_part(given, batches[1 : 1 + count])
    assert len(found.part.bodies) == 2 and told in found.remarks
    assert f"drafted from {blocks} blocks" in found.remarks[0]


def test_too_short_to_leave_any_out_is_one_body_and_says_so(given: Machine, batches: list[Batch]) -> None:
    found = drafted_part(given, [replace(batches[1], table=batches[1].table.iloc[:14])])
    assert len(found.part.bodies) == 1 and found.remarks[0].endswith("of the movement that it was fitted to")
    assert "the recordings are too short to leave any out: one body alone is drafted" in found.remarks


def test_missing_samples_and_coarse_readings_do_no_harm(given: Machine, batches: list[Batch]) -> None:
    rng = np.random.default_rng(0)

    def spoilt(table: pd.DataFrame) -> pd.DataFrame:
        table[["t_shaft", "t_head"]] = (2 * table[["t_shaft", "t_head"]]).round() / 2
        return table.where((table.columns == "time_s") | (rng.random(table.shape) > 0.2))

    found = drafted_part(given, with_tables(batches, spoilt))
    assert list(found.part.bodies) == ["t_shaft", "t_head"]
    assert values_of(given, found.part)["bodies.t_head.capacity"] == pytest.approx(SCALE * 40e3, rel=0.2)


def test_without_an_ambient_the_room_is_what_first_readings_say(given: Machine, batches: list[Batch]) -> None:
    bare = changed(given, room=None)
    found = drafted_part(bare, batches)
    room = found.part.surroundings["room"]
    assert room.first == ("t_shaft", "t_head") and room.per_batch == "1 K"
    assert "no ambient was recorded: the room is taken from first readings" in found.remarks
    assert by(found.left_out, "channel", "left_out")["t_shaft"] < 1.0
    alone = drafted_part(bare, batches[1:2]).part.surroundings["room"]  # blocks start warm: no first readings then
    assert alone.first is None and alone.value is not None


def test_channels_without_values_are_left_out_and_named(given: Machine, batches: list[Batch]) -> None:
    found = drafted_part(given, with_tables(batches, lambda t: t.assign(t_shaft=np.nan, z=np.nan)))
    assert list(found.part.bodies) == ["t_head"] and list(found.part.errors) == []
    assert "temperature t_shaft has values in 0 of 6 batches: left out" in found.remarks
    assert "error z has values in 0 of 6 batches: left out" in found.remarks


def test_a_batch_without_its_driver_is_left_out(given: Machine, batches: list[Batch]) -> None:
    found = drafted_part(given, [*with_tables(batches[:1], lambda t: t.assign(rpm=np.nan)), *batches[1:]])
    assert "batch b00 has holes in rpm: left out of the draft" in found.remarks
    assert "drafted from 5 batches" in found.remarks[0]


def test_a_room_that_moves_is_enough_and_one_capacity_is_held(given: Machine) -> None:
    idle = with_tables(
        empty_batches(given, 6, hours=8.0), lambda t: t.assign(rpm=0.0, room=t["room"] + t["time_s"] / 5e3)
    )
    found = drafted_part(given, recorded(given, idle, start_K=0.1))
    assert not found.part.mechanisms and "driver rpm is never other than 0: left out" in found.remarks
    first = next(iter(found.part.bodies))
    assert f"the capacity of {first} is held at 10 kJ/K" in found.remarks[1]
    assert not compile_network(given, part=found.part).parameters[0].free
    assert min(by(found.scores, "bodies", "share_left").values()) < 0.5


@pytest.mark.parametrize(
    ("unit", "law"),
    [("%", "electrical_heat"), ("1", "electrical_heat"), ("mm/min", "guide_friction"), ("A", "ohmic_heat"),
     ("W", "cutting_heat")],
)  # fmt: skip
def test_every_kind_of_driver_heats_by_its_own_law(given: Machine, batches: list[Batch], unit: str, law: str) -> None:
    other = changed(given, rpm={"unit": unit})
    found = drafted_part(other, batches[:4])
    assert found.part.mechanisms["heat_of_rpm"].law == law
    assert min(by(found.scores, "bodies", "share_left").values()) < 0.2
    compile_network(other, part=found.part)


def test_a_driver_that_no_heat_grows_with_is_named(given: Machine, batches: list[Batch]) -> None:
    found = drafted_part(changed(given, rpm={"unit": "l/min"}), batches)
    assert "driver rpm is in l/min, which no drafted heat grows with: it warms nothing there" in found.remarks


def test_noise_is_stated_where_no_resolution_is(given: Machine, batches: list[Batch]) -> None:
    bare = changed(given, t_shaft={"resolution": None}, z={"resolution": None})
    fine = recorded(given, empty_batches(given, 5, step_s=60.0))
    part = drafted_part(bare, fine).part
    assert part.sensors["t_head"].noise is None
    assert float(str(part.sensors["t_shaft"].noise).removesuffix(" K")) == pytest.approx(0.029, rel=0.15)
    assert float(str(part.errors["z"].noise).removesuffix(" um")) == pytest.approx(0.29, rel=0.15)
    still = drafted_part(bare, recorded(given, empty_batches(given, 5), noise=0.0)).part
    assert float(str(still.sensors["t_shaft"].noise).removesuffix(" K")) >= 0.01


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda t: t.assign(t_shaft=np.nan, t_head=np.nan),
         "machine two_bodies: no network can be drafted: no temperature channel has a value; record one, or give it "
         "role: temperature"),
        (lambda t: t.assign(rpm=0.0, room=20.0),
         "machine two_bodies: no network can be drafted: no driver is ever other than 0 and no ambient moves by "
         "0.3 K: nothing warms it; record what the machine did (speed, feed) or the room, and give it role: driver or "
         "ambient"),
        (lambda t: t.assign(room=t["room"].where((t["time_s"] < 3000) | (t["time_s"] > 6000))),
         "machine two_bodies: no network can be drafted: in every batch a driver or the ambient has no value for more "
         "than 900 s; correct the recordings, or overrule the masks"),
    ],
)  # fmt: skip
def test_what_cannot_be_drafted_is_told_in_one_line(
    given: Machine, batches: list[Batch], change: Callable[[pd.DataFrame], pd.DataFrame], told: str
) -> None:
    with pytest.raises(InputError) as caught:
        drafted_part(given, with_tables(batches, change))
    assert str(caught.value) == told


def test_no_batch_and_no_body_are_told(given: Machine, batches: list[Batch]) -> None:
    with pytest.raises(InputError, match="got no batch; give one or more recordings"):
        drafted_part(given, [])
    with pytest.raises(InputError, match="max_bodies: got 0, expected 1 or more"):
        drafted_part(given, batches, max_bodies=0)


def test_progress_is_told_and_bodies_are_limited(given: Machine, batches: list[Batch]) -> None:
    heard: list[tuple[str, int, int]] = []
    found = drafted_part(given, batches, progress=lambda *a: heard.append(a), max_bodies=1)
    assert heard == [("draft with 1 body", 1, 1)] and len(found.part.bodies) == 1


def test_integrated_balances_give_the_rates_of_two_bodies() -> None:
    time_s = np.arange(0.0, 4 * 3600.0, 10.0)
    body, heat = np.full((len(time_s), 2), 20.0), np.where(time_s < 7200, 1.0, 0.0)
    for k in range(len(time_s) - 1):
        across = 12.0 * (body[k, 0] - body[k, 1])
        body[k + 1, 0] = body[k, 0] + 10.0 * (100.0 * heat[k] - across - 1.0 * (body[k, 0] - 20.0)) / 5e3
        body[k + 1, 1] = body[k, 1] + 10.0 * (across - 8.0 * (body[k, 1] - 20.0)) / 40e3
    balance = Balance(body, np.full(len(time_s), 20.0), heat[:, None], [np.arange(len(time_s))], time_s)
    found = guess(balance, [(0, 1)])
    found = found.scaled(100.0 / found.heat_W.sum())
    assert found.capacity_J_per_K == pytest.approx([5e3, 40e3], rel=0.25)
    assert found.link_W_per_K == pytest.approx([12.0], rel=0.25)
    assert found.exposure_W_per_K == pytest.approx([1.0, 8.0], rel=0.25)
    assert found.heat_W[1, 0] < 1e-6 * found.heat_W[0, 0]


def test_names_are_what_a_machine_file_allows() -> None:
    assert valid_names(["T-1", "T_1", "3rd", "room"], ["room"]) == ("T_1", "T_1_2", "at_3rd", "room_2")
