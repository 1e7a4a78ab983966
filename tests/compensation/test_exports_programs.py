"""Every export: equal to the program, complete in what it states, and clear in what it refuses."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from compensation.exports import EXPORTS
from compensation.exports.base import ExportedAxis, identifiers
from data.batch import Batch, Channel
from data.errors import InputError
from models.families import FAMILIES
from models.program import Builder, Program, replay
from tests.toys.exported import LIMITS, export_of, offset_only, straight

PROGRAMS = tuple(k for k, f in FAMILIES.items() if f.has_program())
Batches = Callable[..., list[Batch]]


def along_y(batch: Batch) -> Batch:
    """The batch with z measured at five positions in turn, and growing along them."""
    at_mm = 100.0 * (np.arange(batch.n_rows) % 5)
    rise = batch.values("t0") - batch.values("t0")[0]
    table = batch.table.assign(y=at_mm, z=batch.values("z") + 0.01 * rise * at_mm)
    channels = dict(batch.channels) | {"y": Channel("y", "position", "mm")}
    return replace(batch, table=table, channels=channels | {"z": replace(channels["z"], position="y")})


@cache
def fitted(
    key: str, make: Batches, inputs: tuple[str, ...] = ("t0", "t2", "t4@lag30min", "room")
) -> tuple[Program, np.ndarray]:
    """A family's program, and the rows of a batch that it was not fitted on."""
    batches = make(5, 40)
    if FAMILIES[key].needs_position:
        batches = [along_y(batch) for batch in batches]
    *train, left = batches
    options = {"random_forest": {"n_trees": 20}, "bp": {"starts": 1}}.get(key, {})
    try:
        family = FAMILIES[key](**options)
    except TypeError:
        family = FAMILIES[key]()
    program = family.fit(train, inputs, "z").program(left.channels, left.step_s)
    return program, np.column_stack([left.masked(c) for c in program.channels] or [np.empty((left.n_rows, 0))])


def every_operation(step_s: float = 300.0) -> Program:
    """A program with all operations, sizes of one and more, and fractional delays; two outputs along y."""
    rng = np.random.default_rng(1)
    known = {n: Channel(n, "temperature", "degC") for n in "abcd"}
    known |= {"rpm": Channel("rpm", "driver", "rpm"), "y": Channel("y", "driver", "mm")}
    b = Builder(known, step_s)
    x, rpm = b.features(["a", "b", "c"]), b.channels(["rpm"], required=False)
    many = b.lags(b.join(x, b.features(["d@rate", "a@rate"])), [600.0, 0.0, 7200.0], 1.0)
    many = b.pick(many, list(range(b.size(many)))[::-1])
    load = b.add("power", [b.join(*[b.scaled(rpm, np.array(1000.0))] * 4)], 4, exponents=[0.0, 1.0, 2.0, 0.7])
    late = b.join(b.delay(x, 450.0, 0.0), b.delay(x, 900.0, 1.0), b.delay(rpm, 100.0, 1.0), b.delay(rpm, 300.0, 0.0))
    middle = b.join(b.add("median", [x], 1), b.add("median", [load], 1), b.add("median", [rpm], 1))
    curve = b.add("curve", [x], 3, knots=[-2.0, 0.0, 1.0, 5.0], values=[3.0, -1.0, 4.0, 2.0])
    level = b.add("curve", [b.add("clock", [], 1)], 1, knots=[600.0], values=[2.5])
    ramp = b.add("curve", [b.add("clock", [], 1)], 1, knots=[600.0, 3000.0], values=[0.0, 9.0])
    net = b.affine(b.add("tanh", [b.affine(x, rng.normal(size=(4, 3)), 0.1)], 4), rng.normal(size=(2, 4)))
    kernel = b.add("kernel", [x], 1, support=rng.normal(size=(7, 3)), weights=rng.normal(size=7), sharpness=0.03)
    trees = [
        b.add("trees", [x], 1, roots=[0, 3, 4], feature=[0, 0, 0, 0, 2, 0, 1, 0, 0], single=single,
              left=[1, 1, 2, 3, 5, 5, 7, 7, 8], right=[2, 1, 2, 3, 6, 5, 8, 7, 8],
              threshold=[0.3, 0, 0, 0, 0.7, 0, -0.2, 0, 0], value=[0, 1, 2, 0.5, 0, 3, 0, -4, 8])
        for single in (0.0, 1.0)
    ]  # fmt: skip
    wide = b.add("mul", [many, many], b.size(many))
    zero, count = b.constant(np.zeros(3)), b.previous(1, -2.0)
    less, alike = b.two("less", x, zero), b.two("equal", b.two("max", x, zero), zero)
    size = b.select(less, b.sub(zero, x), b.two("add", x, b.two("mul", alike, x)))
    total = b.previous(3, 0.5)
    b.feed(total, b.clamp(b.two("add", total, size), b.constant([9.0] * 3), b.constant([20.0, 90.0, 900.0])))
    b.feed(count, b.two("add", count, b.pick(less, [1])))
    whole = b.join(total, count, alike, size, many, load, late, middle, curve, level, ramp, net, kernel, *trees, wide)
    weights = rng.normal(size=(2, b.size(whole)))
    both = b.affine(whole, weights * [[0.1], [0.001]], 0.3)
    return b.program([b.pick(both, [0]), b.pick(both, [1])], False, along="y", reference_mm=120.0)


def rows_with_holes(program: Program, n: int = 60) -> np.ndarray:
    """Random walks; rows begin late, and later every channel misses some."""
    rng = np.random.default_rng(2)
    rows = 20.0 + rng.normal(size=(n, len(program.channels))).cumsum(axis=0)
    rows[:, [c == "rpm" for c in program.channels]] *= 100.0
    rows[:2, 0] = np.nan
    rows[10:40][rng.random((30, rows.shape[1])) < 0.1] = np.nan
    return rows


def dynamic(axis: str = "z") -> ExportedAxis:
    return ExportedAxis(axis, every_operation(), {"a": (5.0, 35.0), "y": (0.0, 500.0)}, LIMITS)


def test_axes_of_different_steps_cannot_share_a_function(tmp_path: Path) -> None:
    slow = replace(dynamic("x"), program=every_operation(600.0))
    with pytest.raises(InputError, match=r"^export c: .*z 300 s, x 600 s.*can: json, st, onnx, receiver, sinumerik$"):
        EXPORTS["c"]().write(export_of(dynamic(), slow), tmp_path)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"axes": ()}, "expected at least one"),
        ({"axes": (dynamic(), dynamic())}, "each once"),
        ({"axes": (replace(dynamic(), region={"a": (3.0, 1.0)}),)}, "trained region of a is 3 to 1"),
        ({"axes": (replace(dynamic(), program=replace(every_operation(), along="")),)}, "2 outputs"),
    ],
)
def test_an_unusable_statement_is_one_line(change: dict[str, object], told: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=told) as error:
        EXPORTS["json"]().write(replace(export_of(dynamic()), **change), tmp_path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("key", ["c", "st"])
def test_a_row_that_is_stale_before_the_next_is_refused(key: str, tmp_path: Path) -> None:
    late = replace(offset_only(), limits=replace(LIMITS, stale_s=299.0))
    with pytest.raises(InputError, match=r"stale_s 299 s, below its step of 300 s; give --stale-s .*can: json, onnx"):
        EXPORTS[key]().write(export_of(late), tmp_path)


def test_a_model_that_is_not_finite_is_refused(tmp_path: Path) -> None:
    a = offset_only()
    nodes = tuple(replace(n, data={k: v * np.nan for k, v in n.data.items()}) if n.op == "affine" else n
                  for n in a.program.nodes)  # fmt: skip
    with pytest.raises(InputError, match=r"\(affine\) is not finite"):
        EXPORTS["c"]().write(export_of(replace(a, program=replace(a.program, nodes=nodes))), tmp_path)


def test_json_gives_the_program_back(tmp_path: Path) -> None:
    program = every_operation()
    (path,) = EXPORTS["json"]().write(export_of(dynamic()), tmp_path)
    stored = json.loads(path.read_text())
    assert stored["schema"] == "thermodrift.export/1"
    (axis,) = stored["axes"]
    rows = rows_with_holes(program)
    assert np.array_equal(replay(Program.from_plain(axis["program"]), rows), replay(program, rows), equal_nan=True)
    assert stored["operations"].keys() == {n.op for n in program.nodes}
    assert axis["inputs"][0] == {
        "channel": "a", "unit": "degC", "required": True, "trained": [5.0, 35.0], "usable": [-25.0, 65.0],
    }  # fmt: skip
    assert axis["limits"]["max_slope_um_per_m"] == pytest.approx(40.0 / 0.38)


def test_sinumerik_states_its_data(tmp_path: Path) -> None:
    (path,) = EXPORTS["sinumerik"]().write(export_of(straight()), tmp_path)
    text = path.read_text()
    for told in ("MD32750", "MD32760", "SD43900", "SD43910", "SD43920", "$MA_TEMP_COMP_TYPE[Y] = 3",
                 "$SA_TEMP_COMP_REF_POSITION[Y] = 100", "SIGN * offset_um / 1000.0"):  # fmt: skip
        assert told in text, told
    assert "keep it above 0.0001." in text  # 40 um at 0.4 m


def test_identifiers_are_distinct_and_plain() -> None:
    assert identifiers(["Fräse 1", "fr_se-1", "1", "__a__b", "µ"]) == ["Fr_se_1", "fr_se_1_2", "m_1", "a_b", "m"]
