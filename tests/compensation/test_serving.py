"""The loop next to the control: no sample, state or signal ends it with a jump."""

from __future__ import annotations

import itertools
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from compensation import safety, serving
from compensation.contracts import Correction, Sample
from compensation.runtime import AxisModel, Compensator
from compensation.safety import Axis, Limits
from compensation.serving import StateFile, serve
from tests.compensation.test_runtime import model_of, samples
from tests.conftest import make_toy_batches

LIMITS = Limits(rate_um_per_s=0.1, step_um=1.0, warm_up_s=0.0, stale_s=1000.0, hold_s=120.0)


@pytest.fixture(scope="module")
def toy() -> tuple[AxisModel, list[Sample]]:
    *train, left = make_toy_batches(8, 60)
    return model_of(train, limits=LIMITS), samples(left)


def compensator(model: AxisModel) -> Compensator:
    return Compensator("toy", [model], period_s=model.program.step_s)


class Given:
    """A source of given samples; a function among them is called."""

    def __init__(self, *given: Sample | Callable[[], object] | None) -> None:
        self.given = given

    def samples(self) -> Iterator[Sample | None]:
        for one in self.given:
            if callable(one):
                one()
            else:
                yield one

    def close(self) -> None: ...


class Kept:
    """A sink that keeps corrections, and the state on disk at the time of each."""

    def __init__(self, state: StateFile | None = None) -> None:
        self.got: list[Correction] = []
        self.state, self.ahead = state, list[float]()

    def write(self, correction: Correction) -> None:
        self.got.append(correction)
        if self.state is not None:
            record = self.state.load()
            assert record is not None and record["heartbeat"] <= correction.heartbeat
            self.ahead.append(record["sent"]["z"]["safety"]["sent_um"])

    def close(self) -> None: ...

    @property
    def sent_um(self) -> list[float]:
        return [c.offset_um["z"] for c in self.got]

    def answers(self, given: Sequence[Sample]) -> list[Correction]:
        """Those at the times of samples; between them what is sent moves on."""
        return [c for c in self.got if c.time_s in {s.time_s for s in given}]


def test_a_channel_that_comes_later_is_a_missing_value_at_first(toy: tuple[AxisModel, list[Sample]]) -> None:
    model, rows = toy
    first = replace(rows[0], values={c: v for c, v in rows[0].values.items() if c != "spindle_rpm"})
    sink = Kept()
    serve(compensator(model), Given(first, *rows[1:20]), [sink], replay=True)
    assert len(sink.answers(rows)) == 20 and sink.got[-1].state["z"] == "active"
    assert [c.heartbeat for c in sink.got] == list(range(1, len(sink.got) + 1))
    assert all(c.valid_until_s > c.time_s for c in sink.got)


def test_what_fails_is_held_then_fades_and_says_which_sample(toy: tuple[AxisModel, list[Sample]]) -> None:
    model, rows = toy
    machine, sink, said = compensator(model), Kept(), list[str]()
    take = machine.take

    def failing(sample: Sample, clock_s: float) -> Correction:
        if sample.time_s >= rows[30].time_s:
            raise ZeroDivisionError("no model")
        return take(sample, clock_s)

    machine.take = failing  # type: ignore[method-assign]
    serve(machine, Given(*rows), [sink], log=said.append, replay=True)
    answers = sink.answers(rows)
    assert len(answers) == len(rows) and answers[29].offset_um["z"] != 0.0
    held = sink.got.index(answers[30])
    assert answers[30].state["z"] == "hold" and sink.sent_um[held] == sink.sent_um[held - 1]
    assert sink.got[-1].state["z"] == "off" and sink.sent_um[-1] == 0.0
    assert max(abs(b - a) for a, b in zip(sink.sent_um, sink.sent_um[1:], strict=False)) <= 1.0 + 1e-9
    assert len(said) == 1 and "ZeroDivisionError (no model): Sample(time_s=" in said[0]


def test_what_is_sent_is_on_disk_before_it_is_sent(toy: tuple[AxisModel, list[Sample]], tmp_path: Path) -> None:
    model, rows = toy
    state = StateFile(tmp_path / "state.json")
    sink = Kept(state)
    serve(compensator(model), Given(*rows[:30]), [sink], state, replay=True, log=lambda line: None)
    assert sink.ahead == sink.sent_um and sink.sent_um[-1] != 0.0


@pytest.mark.parametrize("damage", ["{", '{"sha256": "0", "state": {}}', "[]", "", "[" * 100_000])
def test_a_state_that_cannot_be_read_is_set_aside(
    toy: tuple[AxisModel, list[Sample]], tmp_path: Path, damage: str
) -> None:
    model, rows = toy
    state, said, sink = StateFile(tmp_path / "state.json"), list[str](), Kept()
    state.path.write_text(damage)
    serve(compensator(model), Given(*rows[30:]), [sink], state, replay=True, log=said.append)
    assert (tmp_path / "state.json.unusable").read_text() == damage and len(sink.answers(rows)) == 30
    assert sum("set aside as state.json.unusable" in line for line in said) == 1


@pytest.mark.parametrize(
    "change",
    [{"period_s": 10.0}, {"axes": {}}, {"axes": {"z": {"model": None}}}, {"watch": []}, {"grid_s": "now"}],
)
def test_where_the_models_are_others_what_was_sent_goes_on(
    toy: tuple[AxisModel, list[Sample]], tmp_path: Path, change: dict[str, object]
) -> None:
    model, rows = toy
    state, said, before, after = StateFile(tmp_path / "state.json"), list[str](), Kept(), Kept()
    serve(compensator(model), Given(*rows[:30]), [before], state, replay=True, log=said.append)
    record = state.load()
    assert record is not None
    state.save({**record, **change})
    serve(compensator(model), Given(*rows[30:]), [after], state, replay=True, log=said.append)
    if "watch" not in change:
        assert any("cannot be used" in line and "set aside as state.json.unusable" in line for line in said)
    assert abs(after.sent_um[0]) > 1 and abs(after.sent_um[0] - before.sent_um[-1]) <= 1.0 + 1e-9
    assert after.got[0].heartbeat > before.got[-1].heartbeat


@pytest.mark.parametrize("sent", [{"z": {}}, {"z": None}, [], None, {"z": {"safety": {}, "slope_safety": {}}}])
def test_a_state_that_lacks_what_was_sent_ends_nothing(
    toy: tuple[AxisModel, list[Sample]], tmp_path: Path, sent: object
) -> None:
    model, rows = toy
    state, said, sink = StateFile(tmp_path / "state.json"), list[str](), Kept()
    state.save({**compensator(model).as_plain(), "sent": sent})
    serve(compensator(model), Given(*rows[:5]), [sink], state, replay=True, log=said.append)
    assert len(sink.answers(rows)) == 5 and (sent == [] or "cannot be used" in said[0])


def test_a_stop_by_the_operator_stays_until_he_starts_it(toy: tuple[AxisModel, list[Sample]], tmp_path: Path) -> None:
    model, rows = toy
    fast = replace(model, limits=replace(LIMITS, rate_um_per_s=1e4, step_um=1e3))
    state, said, states = StateFile(tmp_path / "state.json"), list[str](), list[str]()
    machine = compensator(fast)
    for part, start in ((rows[:20], False), (rows[20:30], False), (rows[30:40], False), (rows[40:], True)):
        sink = Kept(state)
        stop = (machine.stop,) if part[0] is rows[0] else ()
        serve(machine, Given(*part[:10], *stop, *part[10:]), [sink], state, said.append, replay=True, start=start)
        states.append(sink.got[-1].state["z"])
        machine = compensator(fast)
    assert states == ["off", "off", "off", "active"]
    assert sum("until `thermodrift compensate --start`" in line for line in said) == 3


@pytest.mark.parametrize("ending", ["signal", "source ends", "source fails"])
def test_a_stop_fades_before_it_ends_and_a_restart_begins_with_warm_up(
    toy: tuple[AxisModel, list[Sample]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ending: str
) -> None:
    model, rows = toy
    fast = replace(model, limits=replace(LIMITS, rate_um_per_s=1e4, step_um=0.5))
    monkeypatch.setattr(serving, "_FADE_STEP_S", 0.001)
    state, sink, said = StateFile(tmp_path / "state.json"), Kept(), list[str]()

    def fail() -> None:
        raise OSError("the cable is out")

    end, why = {
        "signal": ((lambda: os.kill(os.getpid(), signal.SIGTERM), *rows[40:]), "signal to end"),
        "source ends": ((), "the input ends"),
        "source fails": ((fail,), "the input fails (the cable is out)"),
    }[ending]
    with pytest.raises(OSError, match="cable") if ending == "source fails" else nullcontext():
        serve(compensator(fast), Given(*rows[:40], *end), [sink], state, said.append)
    assert max(map(abs, sink.sent_um)) > 1.0 and sink.sent_um[-1] == 0.0 and sink.got[-1].state["z"] == "off"
    assert max(abs(b - a) for a, b in zip(sink.sent_um, sink.sent_um[1:], strict=False)) <= 0.5 + 1e-9
    assert any(why in line for line in said)
    after = Kept()
    serve(compensator(fast), Given(*rows[40:50]), [after], state, said.append, replay=True)
    assert after.got[-1].state["z"] == "active" and "stopped by the operator" not in "".join(said)


def test_a_second_signal_ends_at_once(
    toy: tuple[AxisModel, list[Sample]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, rows = toy
    slow = replace(model, limits=replace(LIMITS, rate_um_per_s=0.01, step_um=0.5, stale_s=30.0))
    monkeypatch.setattr(serving.time, "sleep", lambda s: os.kill(os.getpid(), signal.SIGINT))
    clock = iter(range(10**6))
    monkeypatch.setattr(serving, "_now_s", lambda: (rows[1].time_s - rows[0].time_s) * next(clock))
    sink, said = Kept(), list[str]()
    stop = lambda: os.kill(os.getpid(), signal.SIGTERM)  # noqa: E731
    serve(compensator(slow), Given(*rows[:40], stop, *rows[40:]), [sink], None, said.append)
    assert sink.sent_um[-1] != 0.0 and any("signal: ends with" in line for line in said)


def test_a_full_disk_and_a_sink_that_breaks_end_nothing(toy: tuple[AxisModel, list[Sample]], tmp_path: Path) -> None:
    model, rows = toy
    state, said, good = StateFile(tmp_path / "state.json"), list[str](), Kept()

    class Broken(Kept):
        def write(self, correction: Correction) -> None:
            raise OSError("no route")

    state.path.mkdir()
    serve(compensator(model), Given(*rows[:10]), [Broken(), good], state, replay=True, log=said.append)
    assert len(good.answers(rows)) == 10 and sum("no route" in line for line in said) == 1


@pytest.mark.parametrize("seed", range(3))
def test_computer_and_broker_die_fifty_times_and_nothing_jumps_at_the_receiver(
    toy: tuple[AxisModel, list[Sample]], tmp_path: Path, seed: int
) -> None:
    """The receiver is the state machine that exports lower; a heartbeat that stands still is silence."""
    model, rows = toy
    rng, limits = np.random.default_rng(seed), replace(LIMITS, hold_s=30.0, stale_s=10.0)
    sender = replace(model, limits=replace(LIMITS, stale_s=600.0))
    state = StateFile(tmp_path / f"{seed}.json")
    machine: Compensator | None = None
    receiver, beat, sent_um, deaths = Axis(), -1, [0.0], 0
    broker_until_s = computer_until_s = -1.0
    for clock_s in range(int(rows[-1].time_s - rows[0].time_s)):
        if rng.random() < 1 / 200:
            broker_until_s = clock_s + rng.integers(1, 200)
            deaths += 1
        if rng.random() < 1 / 200:  # dies between two corrections, or between what is written ahead and what is sent
            machine, computer_until_s = None, clock_s + rng.integers(1, 200)
            deaths += 1
        answer = None
        if clock_s >= computer_until_s and clock_s % 10 == 0:
            line = serving._Line(machine or compensator(sender), [], state, lambda line: None, lambda c: None)
            if machine is None:
                line.restore()
            machine = line.machine
            k = int(clock_s // (rows[1].time_s - rows[0].time_s))
            answer = line.answer(replace(rows[k], time_s=rows[0].time_s + clock_s), float(clock_s))
            line.save(float(clock_s), 30.0)
        arrives = answer is not None and clock_s >= broker_until_s and answer.heartbeat != beat
        if answer is not None and arrives:
            beat = answer.heartbeat
            receiver, now_um, _ = safety.step(receiver, limits, clock_s, answer.offset_um["z"])
        else:
            receiver, now_um, _ = safety.silence(receiver, limits, clock_s)
        sent_um.append(now_um)
    assert deaths >= 50 and max(map(abs, sent_um)) > 1.0
    assert np.abs(np.diff(sent_um)).max() <= limits.rate_um_per_s * 1.0 + 1e-9


def test_in_a_replay_what_is_sent_follows_as_at_a_machine_however_seldom_samples_come(
    toy: tuple[AxisModel, list[Sample]],
) -> None:
    """Samples every 300 s: a live loop looks once a second and moves at 0.1 um/s, no more than 1 um at a time."""
    model, given = replace(toy[0], limits=LIMITS, updater=None), toy[1]
    sink = Kept()
    serve(compensator(model), Given(*given), [sink], replay=True)
    steps = np.diff(sink.sent_um)
    assert np.abs(steps).max() <= LIMITS.step_um + 1e-9
    at = {c.time_s: c.offset_um["z"] for c in sink.got}
    free = compensator(replace(model, limits=replace(LIMITS, rate_um_per_s=1e3, step_um=1e6)))
    wanted = {s.time_s: free.take(s, s.time_s).offset_um["z"] for s in given}
    times = sorted(wanted)
    reached = [abs(at[b] - wanted[a]) for a, b in itertools.pairwise(times) if abs(wanted[b] - wanted[a]) < 1]
    assert max(abs(w) for w in wanted.values()) > 10.0 and np.max(reached) <= 2.0


def test_an_axis_that_its_rate_holds_back_says_so(toy: tuple[AxisModel, list[Sample]]) -> None:
    model = replace(toy[0], limits=replace(LIMITS, rate_um_per_s=0.002), updater=None)
    sink = Kept()
    serve(compensator(model), Given(*toy[1]), [sink], replay=True)
    late = [c for c in sink.got if "rate limited: " in c.reasons["z"]]
    assert late and all(c.state["z"] in ("active", "fade-out") and " um behind" in c.reasons["z"] for c in late)
