"""How long does a step take, and does memory stay where it is over a day?

    python -m benchmarks.compensation

Prints for every family that is a program the time of one row of the model, and for one axis with guard, filter of
readings, authority and state machine the time of one sample: medians and 99 % quantiles. Then plays 24 h of samples,
one a second, and prints the resident memory before and after.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from compensation.contracts import Sample
from compensation.runtime import AxisModel, Compensator
from compensation.safety import Limits
from compensation.substitutes import Substitutes
from data.batch import Batch
from features.design import Design
from models.families import FAMILIES
from models.selection.trust import Region
from models.selection.updating import Updater, out_of_fold
from tests.conftest import make_toy_batches

INPUTS = ("t0", "t2", "t4", "t5", "t7", "room")
_DAY_S = 86400


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


def main() -> None:
    *train, left = make_toy_batches(8, 400, sensors=9)
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
        machine = Compensator("toy", [axis_of(train, key, left.step_s)], Substitutes.learn(train, INPUTS), left.step_s)
        samples = [Sample(1e9 + t, v) for t, v in zip(left.time_s, given, strict=True)]
        median, high = quantiles_ms([partial(machine.take, s, s.time_s) for s in samples])
        print(f"{key + ', whole axis':<26} {median:9.3f} {high:9.3f}")
    machine = Compensator("toy", [axis_of(train, "distributed_lag", 10.0)], Substitutes.learn(train, INPUTS), 10.0)
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
