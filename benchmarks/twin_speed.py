"""Speed of the twin: a year of the sample machine, many parameter sets, a Jacobian; next to scipy's stiff solvers.

    python benchmarks/twin.py [--repeats 7] [--sets 500]

The year: 30 batches of 8 h at 10-s steps (the sample year's plans), 14 bodies, 9 sensors with lag and bonding, 3 error
channels. "fresh" prepares everything anew (regimes, cutting into pieces), "again" repeats on the same recordings as a
calibration does; "temperatures alone" reuses the sorted heat as well. scipy integrates the temperatures of one batch,
with an analytic Jacobian, restarted where the speed jumps; its tolerance is the loosest of a scan in half decades, on
one batch, that reaches an accuracy: 1 mK, and the twin's own (not below 1e-7 K; the reference is LSODA at
rtol 1e-12 with steps of 10 s at most). What would take over 20 s is timed on that batch alone and scaled (×30).
Ratios: to the whole simulation, and to the temperatures alone. One thread each, CPU time, medians; nothing is asserted.
"""

from __future__ import annotations

import argparse
import math
import os
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import ParamSpec, TypeVar

import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks.stiff import METHODS, Method, Plain
from benchmarks.table import Row, median_s
from data.arrays import Array
from data.machine import load_machine
from plants.sample import sample_machine as sample
from plants.sample.sample_year import plan_year
from twin.compile import compile_network
from twin.network import Network
from twin.schema import twin_part
from twin.simulation import simulate
from twin.simulation.balance import balance_of
from twin.simulation.coupling import plain_modes
from twin.simulation.inputs import Inputs
from twin.simulation.response import Response
from twin.simulation.sensitivity import sensitivities

P = ParamSpec("P")
T = TypeVar("T")

STEP_S, HOURS, BATCHES = 10.0, 8, 30
TARGET_RATIO = 30.0  # of LSODA at 1 mK, where the heat depends on temperature
TARGET_MS = {"linear": 20.0, "dependent": 500.0, "set": 5.0}
ASKED_K, LEAST_K = 1e-3, 1e-7  # of scipy
MOST_S = 20.0


@dataclass(frozen=True)
class Way:
    """A network of the sample machine with some of its mechanisms left out."""

    name: str
    network: Network
    spinning: bool
    feedback: bool


def ways() -> list[Way]:
    """The sample machine without feedback in one regime, with rotating convection, and as it is."""
    machine = load_machine(Path(__file__).parent.parent / "machines" / "sample_vmc.yml")
    part = twin_part(machine)
    out = []
    for name, without in {
        "linear, one regime": ("front_grease", "rear_grease", "spinning"),
        "linear, rotating convection": ("front_grease", "rear_grease"),
        "temperature-dependent": (),
    }.items():
        rest = {k: v for k, v in part.mechanisms.items() if k not in without}
        network = compile_network(machine, part=part.model_copy(update={"mechanisms": rest}))
        out.append(Way(name, network, "spinning" not in without, not without))
    return out


def year(network: Network, batches: int = BATCHES, hours: float = HOURS) -> tuple[Inputs, Array]:
    """The sample year's plans, all equally long, and their start temperatures (1, B, N)."""
    plans = plan_year(0, batches)
    time_s = np.arange(int(hours * 3600 / STEP_S) + 1, dtype=np.float64) * STEP_S
    start = np.stack([p.start_nodes_degC() for p in plans])[:, [sample.NODE[c] for c in network.cells]]
    room = np.stack([p.room_at(time_s) for p in plans])
    inputs = Inputs(
        batch_ids=tuple(p.name for p in plans),
        time_s=np.repeat(time_s[None], batches, axis=0),
        n_intervals=np.full(batches, len(time_s) - 1),
        drivers={"spindle_rpm": np.stack([p.speed_at(time_s[:-1]) for p in plans])},
        recorded={"room": room},
        clock_h=np.full(batches, np.nan),
        first={"room": room[:, 0]} | {r.channel: start @ r.cells for r in network.readings},
    )
    return inputs, start[None]


def timed(work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> tuple[float, T]:
    """Seconds of CPU time of a call, so that other work on the machine counts little, and what it gives."""
    start = time.process_time()
    value = work(*args, **kwargs)
    return time.process_time() - start, value


def ms(seconds: list[float]) -> float:
    return 1e3 * statistics.median(seconds)


def spread(seconds: list[float]) -> str:
    return f"({1e3 * min(seconds):.1f} to {1e3 * max(seconds):.1f})"


def machine_rates() -> tuple[float, float]:
    """Measured GEMM rate, flop/s, and copy rate, bytes/s read and written, of one core."""
    n = 1000
    a = np.random.default_rng(0).normal(size=(n, n))
    out = np.empty_like(a)
    gemm = min(timed(np.matmul, a, a, out=out)[0] for _ in range(8))
    big, to = np.ones(8_000_000), np.empty(8_000_000)
    copy = min(timed(np.copyto, to, big)[0] for _ in range(8))
    return 2 * n**3 / gemm, 2 * big.nbytes / copy


def linear_work(way: Way, inputs: Inputs) -> tuple[float, float, int]:
    """Flops of the modal method for one year, bytes of one pass over all states, and the number of heat series."""
    balance = balance_of(way.network, way.network.values[None], inputs)
    series = sum(directions.shape[2] for directions, _ in balance.known)
    n, rows = way.network.n_cells, int(inputs.n_intervals.sum())
    n_out = len(way.network.readings) + len(way.network.errors)
    # heat of each series at both ends of an interval into each mode, the recursion there and back, the reading
    return rows * (2 * 2 * series * n + 4 * n + 2 * n * n_out), 8.0 * rows * n, series


def year_table(all_ways: list[Way], repeats: int, gemm: float, copy: float) -> dict[str, tuple[float, float]]:
    """Times of the year; by way the medians of "again" and of the temperatures alone, ms."""
    print(f"{'one year, 30 × 8 h at 10 s':30} {'fresh ms':>9} {'again ms':>9} {'min–max':>17} {'target':>7}")
    out = {}
    for way in all_ways:
        network = way.network
        kept, start = year(network)
        by_minute = replace(kept, every=6)
        for given in (kept, by_minute):
            simulate(network, network.values, given, start)
        fresh, again, coarse, bare = [], [], [], []
        balance = balance_of(network, network.values[None], kept)
        response = Response(plain_modes(balance), balance.schedule)
        forcing, every_cell = balance.forcing(response), np.eye(network.n_cells)[None]
        response.outputs(forcing, start, every_cell)
        for _ in range(repeats):
            new = replace(kept)
            fresh.append(timed(simulate, network, network.values, new, start)[0])
            again.append(timed(simulate, network, network.values, kept, start)[0])
            coarse.append(timed(simulate, network, network.values, by_minute, start)[0])
            if not way.feedback:
                bare.append(timed(response.outputs, forcing, start, every_cell)[0])
        out[way.name] = ms(again), ms(bare) if bare else ms(coarse)
        target = TARGET_MS["dependent" if way.feedback else "linear"]
        print(f"{way.name:30} {ms(fresh):9.1f} {ms(again):9.1f} {spread(again):>17} {target:7.0f}")
        print(f"{'  rows every 60 s':30} {'':9} {ms(coarse):9.1f} {spread(coarse):>17}")
        if not way.feedback:
            print(f"{'  14 temperatures alone':30} {'':9} {ms(bare):9.1f} {spread(bare):>17}")
            flops, states, series = linear_work(way, kept)
            floor = flops / gemm
            print(
                f"  arithmetic: {series} heat series, {flops / 1e6:.0f} Mflop = {1e3 * floor:.2f} ms at the GEMM rate; "
                f"the simulation takes {ms(again) / 1e3 / floor:.0f}×; one pass over the states (write, read) "
                f"{2e3 * states / copy:.2f} ms"
            )
    return out


def sets_table(all_ways: list[Way], n_sets: int, repeats: int) -> None:
    """Many parameter sets at once, ms per set and year."""
    print(f"\n{'parameter sets at once, rows every 300 s':42} {'sets':>5} {'ms per set':>11} {'target':>7}")
    rng = np.random.default_rng(0)
    for way, n in [(all_ways[0], n_sets), (all_ways[1], n_sets), (all_ways[2], max(n_sets // 10, 1))]:
        network = way.network
        inputs, start = year(network)
        inputs = replace(inputs, every=30)
        values = np.repeat(network.values[None], n, axis=0)
        values[:, network.free] *= np.exp(rng.normal(0.0, 0.1, (n, len(network.free))))
        took = [timed(simulate, network, values, inputs, start)[0] for _ in range(repeats)]
        target = f"{TARGET_MS['set']:7.0f}" if not way.feedback else ""
        print(f"{way.name:42} {n:5} {ms(took) / n:11.2f} {target}")


def jacobian_table(way: Way, repeats: int) -> None:
    """The Jacobian by all free parameters of 12 batches."""
    network = way.network
    inputs, start = year(network)
    print(f"\nJacobian by the {len(network.free)} free parameters, {way.name}, 12 batches of 8 h")
    for step_s in (10, 300):
        every = int(step_s / STEP_S)
        coarse = replace(
            inputs, time_s=inputs.time_s[:, ::every], n_intervals=inputs.n_intervals // every,
            drivers={n: v[:, ::every] for n, v in inputs.drivers.items()},
            recorded={n: v[:, ::every] for n, v in inputs.recorded.items()}, every=30 // every,
        ).batch(slice(0, 12))  # fmt: skip
        work = partial(sensitivities, network, network.values, coarse, start[:, :12])
        work()
        took = [timed(work)[0] for _ in range(repeats)]
        alone = [
            timed(simulate, network, network.values, replace(coarse, every=1), start[:, :12])[0] for _ in range(repeats)
        ]
        print(
            f"  steps of {step_s:3} s, rows every 300 s: {ms(took):8.0f} ms {spread(took)} = "
            f"{ms(took) / ms(alone):.0f} simulations; finite differences would take {len(network.free) + 1}"
        )


def scipy_table(all_ways: list[Way], year_ms: dict[str, tuple[float, float]]) -> None:
    """scipy's stiff solvers on one batch, the tolerance scanned for the twin's accuracy."""
    print(
        f"\n{'scipy, one year':30} {'method':6} {'rtol':>7} {'error K':>9} {'year s':>8} "
        f"{'twin K':>9} {'ratio':>8} {'alone':>8}"
    )
    for way in all_ways:
        inputs, start = year(way.network)
        batch = next(b for b, i in enumerate(inputs.batch_ids) if "4000" in i)
        order = [sample.NODE[c] for c in way.network.cells]
        plain = plain_of(way, inputs, start, batch)
        every = [plain_of(way, inputs, start, b) for b in range(BATCHES)]
        exact = plain.solve("LSODA", 1e-12, max_step=STEP_S)[:, order]
        ours = simulate(way.network, way.network.values, inputs, start, keep_cells=True).cells_degC
        assert ours is not None
        error_K = float(np.abs(ours[0, batch] - exact).max())
        for method in METHODS:
            for asked_K in (ASKED_K, max(error_K, LEAST_K)):
                rtol, theirs_K = loosest(plain, method, asked_K, exact, order)
                one_s = statistics.median(timed(plain.solve, method, rtol)[0] for _ in range(3))
                scaled = one_s * BATCHES > MOST_S
                seconds = one_s * BATCHES if scaled else sum(timed(p.solve, method, rtol)[0] for p in every)
                whole, alone = (1e3 * seconds / took for took in year_ms[way.name])
                print(
                    f"{way.name:30} {method:6} {rtol:7.0e} {theirs_K:9.1e} {seconds:8.2f} {error_K:9.1e} "
                    f"{whole:7.0f}× {alone:7.0f}×{'  ×30' if scaled else ''}",
                    flush=True,
                )


def rows(all_ways: list[Way], repeats: int, batches: int = BATCHES, hours: float = HOURS) -> list[Row]:
    """Rows of the table: the year of each way next to LSODA at 1 mK and at the twin's own accuracy.

    LSODA integrates the temperatures of the first batch, times their number.
    """
    out = []
    for way in all_ways:
        inputs, start = year(way.network, batches, hours)
        simulate(way.network, way.network.values, inputs, start)
        took_s = median_s(partial(simulate, way.network, way.network.values, inputs, start), repeats)
        order = [sample.NODE[c] for c in way.network.cells]
        plain = plain_of(way, inputs, start, 0)
        exact = plain.solve("LSODA", 1e-12, max_step=STEP_S)[:, order]
        ours = simulate(way.network, way.network.values, inputs, start, keep_cells=True).cells_degC
        assert ours is not None
        error_K = float(np.abs(ours[0, 0] - exact).max())
        for asked_K in (ASKED_K, max(error_K, LEAST_K)):
            rtol, theirs_K = loosest(plain, "LSODA", asked_K, exact, order)
            one_s = median_s(partial(plain.solve, "LSODA", rtol), max(repeats // 2, 1))
            target_s = (
                TARGET_MS["linear"] / 1e3 if not way.feedback and (batches, hours) == (BATCHES, HOURS) else math.nan
            )
            what, reference = f"twin, {batches} × {hours:g} h, {way.name}", f"SciPy, LSODA to {theirs_K:.0e} K"
            out.append(Row(
                what, took_s, reference, one_s * batches,
                TARGET_RATIO if way.feedback else math.nan, target_s, note=f"{error_K:.0e} K",
            ))  # fmt: skip
    return out


def plain_of(way: Way, inputs: Inputs, start: Array, batch: int) -> Plain:
    order = [sample.NODE[c] for c in way.network.cells]
    return Plain(inputs, batch, start[0, batch][np.argsort(order)], way.spinning, way.feedback)


def loosest(plain: Plain, method: Method, asked_K: float, exact: Array, order: list[int]) -> tuple[float, float]:
    """The loosest relative tolerance that reaches an accuracy, and the error that it leaves; at most 1e-12."""
    for power in np.arange(3.0, 12.5, 0.5):
        rtol = 10.0**-power
        error_K = float(np.abs(plain.solve(method, rtol)[:, order] - exact).max())
        if error_K <= asked_K:
            break
    return rtol, error_K


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--sets", type=int, default=500)
    args = parser.parse_args()
    with threadpool_limits(limits=1):
        gemm, copy = machine_rates()
        load = os.getloadavg()[0]
        print(
            f"one thread: GEMM {gemm / 1e9:.1f} Gflop/s, copy {copy / 1e9:.1f} GB/s; load of the machine {load:.1f}\n"
        )
        all_ways = ways()
        year_ms = year_table(all_ways, args.repeats, gemm, copy)
        sets_table(all_ways, args.sets, max(args.repeats // 3, 1))
        jacobian_table(all_ways[2], max(args.repeats // 2, 1))
        scipy_table(all_ways, year_ms)
