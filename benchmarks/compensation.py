"""How long does a step take, and does memory stay where it is over a day?

    python -m benchmarks.compensation [--through mqtt://HOST:PORT/PREFIX]

Prints for every family that is a program the time of one row of the model, and for one axis with guard, filter of
readings, authority and state machine the time of one sample: medians and 99 % quantiles. Then plays 24 h of samples,
one a second, and prints the resident memory before and after. With a broker it prints only, of samples through it, the
time from a sample to its correction and the processor time of the compensation, which runs in a process of its own.
"""

from __future__ import annotations

import argparse
import os
import signal
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path

import numpy as np

from compensation.connectors import open_sink, open_source
from compensation.connectors.mqtt import MqttExchange
from compensation.contracts import Sample
from compensation.runtime import AxisModel, Compensator
from compensation.safety import Limits
from compensation.serving import serve
from compensation.substitutes import Substitutes
from data.batch import Batch
from data.machine import parse_machine
from features.design import Design
from models.families import FAMILIES
from models.selection.trust import Region
from models.selection.updating import Updater, out_of_fold
from tests.conftest import make_toy_batches

INPUTS = ("t0", "t2", "t4", "t5", "t7", "room")
_DAY_S = 86400
_SENT, _FIRST = 1000, 20  # samples through a broker, and those before that connect and import
_MACHINE = "machine: toy\nchannels:\n  z: {role: error, unit: um}\n"


def axis_of(train: Sequence[Batch], key: str, period_s: float) -> AxisModel:
    family = FAMILIES[key]().fit(train, INPUTS, "z")
    design, region, channels = Design.build(train, INPUTS, "z"), Region.of(train, INPUTS), train[0].channels
    updater = Updater.learn(out_of_fold(design, key, range(len(train))))
    return AxisModel(
        "z", family.program(channels, period_s), INPUTS, design.input_units, region, region.program(channels, period_s),
        None, updater, Limits(stale_s=1000.0),
    )  # fmt: skip


def quantiles_ms(calls: Sequence[Callable[[], object]]) -> tuple[float, float]:
    times = []
    for call in calls:
        begun = time.perf_counter()
        call()
        times.append(time.perf_counter() - begun)
    return 1e3 * float(np.median(times)), 1e3 * float(np.quantile(times, 0.99))


def resident_MB() -> float:
    text = Path("/proc/self/status").read_text()
    return float(next(line.split()[1] for line in text.splitlines() if line.startswith("VmRSS"))) / 1024


def whole_axis(train: Sequence[Batch], key: str, period_s: float) -> Compensator:
    return Compensator("toy", [axis_of(train, key, period_s)], Substitutes.learn(train, INPUTS), period_s)


def through(address: str, train: Sequence[Batch], left: Batch) -> None:
    """Samples through a broker to a compensation in a process of its own, and its corrections back."""
    machine = whole_axis(train, "distributed_lag", 10.0)
    text = _MACHINE + "".join(f"  {c}: {{role: temperature, unit: degC}}\n" for c in INPUTS)
    described = parse_machine(text, "benchmark")
    if not (pid := os.fork()):
        signal.signal(signal.SIGTERM, lambda *_: os._exit(0))
        serve(machine, open_source(address, described), [open_sink(address, described)], replay=True)
        os._exit(0)
    ticks, took = list[int](), list[float]()
    try:
        with closing(MqttExchange(address)) as exchange:
            for k in range(_FIRST + _SENT):
                row = k % left.n_rows
                sample = Sample(1e9 + k, {c: float(left.values(c)[row]) for c in INPUTS})
                begun = time.perf_counter()
                exchange(sample)
                took.append(time.perf_counter() - begun)
                ticks.append(sum(map(int, Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:13])))
    finally:
        os.kill(pid, signal.SIGTERM)
        os.waitpid(pid, 0)
    own = 1e3 * np.array(took[_FIRST:])
    cpu_ms = 1e3 * (ticks[-1] - ticks[_FIRST - 1]) / os.sysconf("SC_CLK_TCK") / _SENT
    print(f"{_SENT} samples through {address}: median {np.median(own):.2f} ms, 99 % {np.quantile(own, 0.99):.2f} ms; "
          f"processor {cpu_ms:.2f} ms a sample")  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--through", help="address of a broker, such as mqtt://127.0.0.1:1883/hall/mill")
    asked = parser.parse_args()
    *train, left = make_toy_batches(8, 400, sensors=9)
    if asked.through:
        through(asked.through, train, left)
        return
    print(f"{'family':<26} {'median':>9} {'99 %':>9}   of one row of the model, ms")
    for key, family in FAMILIES.items():
        if not family.has_program() or key == "axis_coupled":
            continue
        program = FAMILIES[key]().fit(train, INPUTS, "z").program(left.channels, left.step_s)
        run, state = program.runner(), program.begin()
        rows = np.column_stack([left.values(c) for c in program.channels] or [np.empty((left.n_rows, 0))])
        median, high = quantiles_ms([partial(run, state, rows[k % len(rows)]) for k in range(4000)])
        print(f"{key:<26} {median:9.3f} {high:9.3f}")
    columns = {c: left.values(c) for c in left.channels if c not in ("z", "x")}
    given = [{c: float(v[k]) for c, v in columns.items()} for k in range(left.n_rows)]
    for key in ("ridge", "distributed_lag", "lag_dictionary"):
        machine = whole_axis(train, key, left.step_s)
        samples = [Sample(1e9 + t, v) for t, v in zip(left.time_s, given, strict=True)]
        median, high = quantiles_ms([partial(machine.take, s, s.time_s) for s in samples])
        print(f"{key + ', whole axis':<26} {median:9.3f} {high:9.3f}")
    machine = whole_axis(train, "distributed_lag", 10.0)
    before, begun = 0.0, time.perf_counter()
    for second in range(_DAY_S):
        if second == 600:
            before = resident_MB()
        values = given[min(second // 300, len(given) - 1)]
        machine.take(Sample(1e9 + second, values, {"z": 1.0} if second % 3600 == 1800 else {}), float(second))
    took_s = time.perf_counter() - begun
    print(f"24 h of samples, one a second, took {took_s:.0f} s")
    print(f"resident memory: {before:.1f} MB after 10 min, {resident_MB():.1f} MB at the end")


if __name__ == "__main__":
    main()
