"""What exports send, under hostile streams: C, structured text and the core give the same to 1e-9 µm."""

from __future__ import annotations

import ctypes
import re
import shutil
from collections.abc import Sequence
from dataclasses import replace
from math import inf, isfinite, nan
from pathlib import Path

import numpy as np
import pytest
from test_exports_st import Block
from test_runtime import INPUTS, model_of

from compensation import core
from compensation.exports import EXPORTS
from compensation.exports.base import Export, ExportedAxis
from compensation.exports.region import trust_program
from compensation.safety import Axis, Limits, silence, step
from data.batch import Channel
from features.rises import feature
from models.program import Builder, replay
from models.selection.conformal import RunBound
from tests.conftest import make_toy_batches
from tests.toys.exported import C, export_of, offset_only, straight

LIMITS = Limits(max_offset_um=40.0, rate_um_per_s=0.5, step_um=2.0, hold_s=60.0, stale_s=900.0, warm_up_s=20.0)
needs_gcc = pytest.mark.skipif(shutil.which("gcc") is None, reason="needs gcc to compile the C export")


def machine(stale_s: float = 5.0) -> Export:
    """An axis with a slope, and one without."""
    limits = replace(LIMITS, stale_s=stale_s)
    return export_of(replace(straight(), limits=limits), replace(offset_only(), axis="z", limits=limits))


class Sender:
    """What an export must send: the core for each output of each axis."""

    def __init__(self, axes: Sequence[ExportedAxis]) -> None:
        self.axes = axes
        self.carried = [[tuple(core.CARRIED.values()) for _ in a.sent] for a in axes]

    def move(
        self, k: int, elapsed_s: float, wanted_um: Sequence[float] | None, faulty: bool, stopped: bool
    ) -> list[float]:
        a, out = self.axes[k], []
        for i, (_, _, um) in enumerate(a.sent):
            usable = wanted_um is not None
            event = (elapsed_s, wanted_um[i] if usable else 0.0, float(usable), float(faulty), float(stopped))
            self.carried[k][i] = core.run()(
                (*event, *(getattr(a.limits, name) for name in core.LIMITS)), *self.carried[k][i]
            )
            out.append(self.carried[k][i][1] / um)
        return out

    def state(self, k: int) -> int:
        return int(self.carried[k][0][0])


def blocks(export: Export, key: str) -> list[Block]:
    (text,) = (t for n, t in EXPORTS[key]().files(export).items() if n.endswith(".st"))
    assert isinstance(text, str)
    return [Block(part) for part in re.findall(r"\(\*\n   thermodrift.*?END_FUNCTION_BLOCK\n", text, re.S)]


def pieces(rng: np.random.Generator, n: int, kinds: Sequence[str]) -> list[str]:
    """Runs of 1 to 40 rows of each kind."""
    out: list[str] = []
    while len(out) < n:
        out += [str(rng.choice(kinds))] * int(rng.integers(1, 40))
    return out[:n]


KINDS = ("good", "good", "good", "dead", "invalid", "odd", "jump", "stopped")


@needs_gcc
@pytest.mark.parametrize("seed", range(4))
def test_the_receiver_is_the_core_whatever_arrives(seed: int, tmp_path: Path) -> None:
    export, rng = machine(), np.random.default_rng(seed)
    made, of_axis, expected = C(export, "receiver", tmp_path), blocks(export, "receiver"), Sender(export.axes)
    heartbeat, value, before, states, last_s = 0, np.zeros(3), np.zeros(3), set(), 0.0
    for number, kind in enumerate(pieces(rng, 1500, KINDS)):
        elapsed_s = float(
            rng.choice([1.0, 0.1, 0.0, 30.0, -5.0, 1e12, nan], p=[0.6, 0.2, 0.08, 0.04, 0.04, 0.02, 0.02])
        )
        value = np.array([10.0, -100.0, 300.0]) if kind == "jump" and rng.random() < 0.5 else value + rng.normal(size=3)
        sent = np.where(rng.random(3) < 0.3, rng.choice([nan, inf, -inf, 1e308]), value) if kind == "odd" else value
        heartbeat += int(kind != "dead")
        valid, enable = kind != "invalid", kind != "stopped"
        last_s = elapsed_s if elapsed_s > 0.0 else last_s
        credited_s = 0.0 if elapsed_s <= 0.0 else last_s
        wanted: list[float] = []
        for k, a in enumerate(export.axes):
            came = [sent[0], sent[1]] if k == 0 else [sent[2]]
            good = valid and all(isfinite(v) and abs(v) <= 1e30 for v in came)
            alive = number > 0 and kind != "dead"
            asked = [v * um for v, (_, _, um) in zip(came, a.sent, strict=True)] if good and alive else None
            wanted += expected.move(k, credited_s, asked, not good, not enable)
        got_st: list[float] = []
        for k, (block, a) in enumerate(zip(of_axis, export.axes, strict=True)):
            given = {"received_offset_um": sent[0 if k == 0 else 2]} | (
                {"received_slope_um_per_m": sent[1]} if k == 0 else {}
            )
            done = block.call(elapsed_s=elapsed_s, enable=enable, heartbeat=heartbeat, valid=valid, **given)
            got_st += [done[output] for output, _, _ in a.sent]
            assert done["state"] == expected.state(k)
            states.add(done["state"])
        offset, slope = np.zeros(2), np.zeros(2)
        for k in range(2):
            made.call("enable", k, int(enable))
        received = np.array([sent[0], sent[2]]), np.array([sent[1], 0.0])
        made.call("receive", ctypes.c_double(elapsed_s), *received, ctypes.c_long(heartbeat), int(valid), offset, slope)
        assert np.abs(np.array([offset[0], slope[0], offset[1]]) - wanted).max() <= 1e-9
        assert np.abs(np.array(got_st) - wanted).max() <= 1e-9
        assert [made.call("state", k) for k in range(2)] == [expected.state(k) for k in range(2)]
        moved = np.abs(np.array(wanted) - before) * [1.0, export.axes[0].lever_m, 1.0]
        assert moved.max() <= min(0.5 * min(credited_s, 5.0), 2.0) + 1e-9
        before = np.array(wanted)
    assert states == {0, 1, 2, 3, 4}


def test_a_dead_sender_is_held_then_fades_without_a_jump() -> None:
    (_, block), sent = blocks(machine(), "receiver"), []
    for t in range(60):
        sent.append(block.call(elapsed_s=1.0, heartbeat=t, valid=True, received_offset_um=10.0)["offset_um"])
    assert sent[21] == 0.5 and sent[-1] == 10.0
    for _ in range(120):
        sent.append(block.call(elapsed_s=1.0)["offset_um"])
    assert sent[60 : 60 + 65] == [10.0] * 65 and sent[-1] == 0.0
    assert np.abs(np.diff(sent)).max() == 0.5


@needs_gcc
@pytest.mark.parametrize("elapsed_s", [nan, inf])
def test_a_dead_sender_fades_also_where_the_elapsed_time_is_no_number(elapsed_s: float, tmp_path: Path) -> None:
    export = machine()
    made, (_, block) = C(export, "receiver", tmp_path), blocks(export, "receiver")
    received, offset, slope, axis = np.array([0.0, 10.0]), np.zeros(2), np.zeros(2), Axis()
    limits, got = replace(LIMITS, stale_s=5.0), []
    for t in range(240):
        passed_s, beat = (1.0, t) if t < 60 else (elapsed_s, 59)
        made.call("receive", ctypes.c_double(passed_s), received, np.zeros(2), ctypes.c_long(beat), 1, offset, slope)
        done = block.call(elapsed_s=passed_s, heartbeat=beat, valid=True, received_offset_um=10.0)
        if 0 < t < 60:  # the heartbeat of the first call says nothing
            axis, sent_um, _ = step(axis, limits, float(t), 10.0)
        else:
            axis, sent_um, _ = silence(axis, limits, float(t) if t < 60 else elapsed_s)
        got.append((offset[1], done["offset_um"], sent_um))
    assert got[59] == (10.0, 10.0, 10.0) and got[-1] == (0.0, 0.0, 0.0)
    assert np.abs(np.diff(got, axis=0)).max() == 0.5 and np.ptp(got, axis=1).max() == 0.0


def weighed() -> ExportedAxis:
    """An offset whose trust falls outside 10 to 30 degC of t0, which cannot be beyond -20 and 60 degC."""
    a = offset_only()
    b = Builder({n: Channel(n, "temperature", "degC") for n in ("t0", "t1")}, 300.0)
    x = b.channels(["t0"])
    beyond = b.two("max", b.sub(x, b.constant(30.0)), b.constant(0.0))
    one = b.constant(1.0)
    trust = b.add("power", [b.two("add", one, b.scaled(beyond, np.array(20.0)))], 1, exponents=[-1.0])
    return replace(a, limits=LIMITS, plausible={"t0": (-20.0, 60.0)}, trust=b.program([trust], False))


@needs_gcc
@pytest.mark.parametrize("seed", range(3))
def test_a_model_at_the_control_sends_what_the_core_does(seed: int, tmp_path: Path) -> None:
    a, rng = weighed(), np.random.default_rng(seed)
    export = export_of(a)
    made, (block,), expected = C(export, "c", tmp_path), blocks(export, "st"), Sender([a])
    assert a.trust is not None
    run, weigh = a.program.runner(), a.trust.runner()
    state, trusted, row, seen = a.program.begin(), a.trust.begin(), np.array([20.0, 20.0]), set()
    for kind in pieces(rng, 900, ("good", "good", "hot", "broken", "silent", "stopped", "reset")):
        reset = kind == "reset" and rng.random() < 0.2
        if reset:
            state, trusted = a.program.begin(), a.trust.begin()
            made.call("reset")
        row = row + rng.normal(size=2) * 0.3
        now = row + np.array([25.0, 0.0]) if kind == "hot" else row
        if kind == "broken":
            now = np.where(rng.random(2) < 0.5, rng.choice([nan, inf, -31.4, 1e6]), now)
        usable = np.array([low <= v <= high for v, (low, high) in zip(now, a.usable(), strict=True)])
        wanted = None
        if kind != "silent":
            error = run(state, np.where(usable, now, nan))
            trust = weigh(trusted, np.where(usable, now, nan)[:1])
            wanted = [-float(error[0] * trust[0])] if isfinite(error[0]) else None
        elapsed_s = 300.0
        (sent,) = expected.move(0, elapsed_s, wanted, kind != "silent" and wanted is None, kind == "stopped")
        offset, slope = np.zeros(1), np.zeros(1)
        made.call("enable", 0, int(kind != "stopped"))
        if kind != "silent":
            made.call("correction_row", np.ascontiguousarray(now))
        made.call("correction_move", ctypes.c_double(elapsed_s), offset, slope)
        given = {
            "in_t0": now[0],
            "in_t1": now[1],
            "fresh": kind != "silent",
            "reset": reset,
            "enable": kind != "stopped",
        }
        done = block.call(elapsed_s=elapsed_s, **given)
        assert abs(offset[0] - sent) <= 1e-9 and abs(done["offset_um"] - sent) <= 1e-9
        assert done["state"] == made.call("state", 0) == expected.state(0)
        seen.add(done["state"])
    assert seen >= {1, 2, 3, 4}


@pytest.mark.parametrize("share", [1.0, 0.6])
def test_the_trust_of_an_export_is_that_of_the_runtime(share: float) -> None:
    *train, left = make_toy_batches(8, 60)
    far_away = replace(left, table=left.table.assign(t0=left.table["t0"] * 3, room=left.table["room"] + 30.0))
    for bound in (None, RunBound(1.0, 2.0, (0.3, 1.7), 1.0, 0.1, 0.4, 0.9, 8)):
        model = replace(model_of(train), share=share, bound=bound)
        program = trust_program(model, left.channels)
        assert program is not None and set(program.channels) <= set(model.program.channels)
        seen = set()
        for batch in (train[0], left, far_away):
            values = {name: feature(batch, name) for name in model.region.ranges if name.partition("@")[0] in INPUTS}
            distance = model.region.distance(values)
            got = replay(program, np.column_stack([batch.values(c) for c in program.channels]))[:, 0]
            assert np.abs(got - [model.authority(d) / share for d in distance]).max() < 1e-9
            seen |= set(np.round(got, 3))
        assert 1.0 in seen and min(seen) < 0.9


def test_a_value_beyond_what_a_sensor_can_have_is_a_fault() -> None:
    assert replace(offset_only(), plausible={"t0": (-5.0, 60.0)}).usable()[0] == (-5.0, 50.0)


def test_twincat_has_the_same_block() -> None:
    files = EXPORTS["receiver"]().files(machine())
    text = files["mill_1_receiver_z.TcPOU"]
    assert isinstance(text, str)
    declaration, body = re.findall(r"<!\[CDATA\[(.*?)\]\]>", text, re.S)
    whole = files["mill_1_receiver.st"]
    assert isinstance(whole, str)
    assert declaration.strip() in whole and body.strip() in whole and 'Name="FB_mill_1_receiver_z"' in text
