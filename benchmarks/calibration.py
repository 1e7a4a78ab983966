"""Calibration of the sample machine: time, left-out errors, and how often the 90 % intervals hold the truth.

    python -m benchmarks.calibration [--repeats 3] [--batches 12]
    python -m benchmarks.calibration --left-out [--batches 30] [--processes 2]
    python -m benchmarks.calibration --coverage 20 [--batches 12]

Time: a calibration of all free parameters on batches of the simulated sample year, on one core, without and with the
part that is done once (compiling, reading). Left out: every batch predicted free-running by a calibration on the
others, mean ± sd over batches. Coverage: the machine's own network with parameters drawn from their priors, every
batch with a start of its own, rounded and with probe noise. Nothing is asserted about time.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from data.batch import Batch
from data.machine import Machine, load_machine
from data.recording import read_batches
from plants.sample.sample_year import PROBE_NOISE_UM, PROBE_STEP_UM, TEMPERATURE_STEP_K, write_sample_year
from twin.calibration import TOLERANCE, calibrate
from twin.calibration.estimate import CalibrationOptions, leave_batch_out
from twin.calibration.identifiability import intervals90
from twin.calibration.least_squares import FitOptions, fit
from twin.calibration.problem import CalibrationProblem
from twin.compile import compile_network
from twin.network import Network
from twin.simulation import simulate
from twin.simulation.inputs import inputs_of
from twin.simulation.start import start_of

MACHINE = Path(__file__).parents[1] / "machines" / "sample_vmc.yml"


def sample_year(machine: Machine, count: int) -> list[Batch]:
    """So many of the year's 30 batches, spread over it."""
    with tempfile.TemporaryDirectory() as folder:
        files = write_sample_year(Path(folder), seed=0)
        chosen = [files[i] for i in np.linspace(0, len(files) - 1, count).astype(int)]
        return [batch for file in chosen for batch in read_batches(file, machine)]


def seconds(machine: Machine, batches: list[Batch], repeats: int) -> None:
    print(f"{len(compile_network(machine).free)} free parameters, {len(batches)} batches, one core")
    wall, cpu = [], []
    for _ in range(repeats):
        begun, used = time.perf_counter(), time.process_time()
        done = calibrate(machine, batches)
        wall.append(time.perf_counter() - begun)
        cpu.append(time.process_time() - used)
        print(f"  wall {wall[-1]:.2f} s, cpu {cpu[-1]:.2f} s: {done.fit.message}")
    for name, each in (("wall", wall), ("cpu", cpu)):
        print(f"{name}: min {min(each):.2f} s, median {statistics.median(each):.2f} s of {repeats}")


def left_out(machine: Machine, batches: list[Batch], processes: int) -> None:
    begun = time.perf_counter()
    problem = CalibrationProblem.of(compile_network(machine), batches)
    found = leave_batch_out(problem, CalibrationOptions(processes=processes))
    print(found.by_channel().round(2).to_string(index=False))
    print(f"{found.summary}; {time.perf_counter() - begun:.0f} s in {processes} processes")


def own_recordings(network: Network, batches: list[Batch], values: NDArray[np.float64], seed: int) -> list[Batch]:
    """The batches with what the network itself shows at parameter values (n,), rounded as the sample year is."""
    rng = np.random.default_rng(seed)
    inputs = inputs_of(network, batches, substeps=8)
    start = start_of(network, network.values, inputs)
    for cells in network.bodies.values():
        start[:, cells] += network.start_spread_K * rng.standard_normal((len(batches), 1))
    shown = simulate(network, values, inputs, start[None])
    out = []
    for b, batch in enumerate(batches):
        table, n = batch.table.copy(), batch.n_rows
        for c, r in enumerate(network.readings):
            table[r.channel] = _stepped(shown.readings[0, b, :n, c], TEMPERATURE_STEP_K)
        for c, e in enumerate(network.errors):
            noise = PROBE_NOISE_UM * rng.standard_normal(n)
            table[e.channel] = _stepped(shown.errors[0, b, :n, c] + noise, PROBE_STEP_UM)
        out.append(replace(batch, table=table))
    return out


def coverage(machine: Machine, batches: list[Batch], repetitions: int) -> None:
    network = compile_network(machine)
    held, away = [], []
    for seed in range(repetitions):
        rng = np.random.default_rng(1000 + seed)
        values = network.values.copy()
        for k in network.free:
            p = network.parameters[k]
            values[k] = np.clip(p.from_x(p.to_x(p.prior_value) + p.spread * rng.standard_normal()), p.low, p.high)
        problem = CalibrationProblem.of(network, own_recordings(network, batches, values, seed))
        done = fit(problem, FitOptions(tolerance=TOLERANCE, reweight=True))
        truth = np.array([network.parameters[k].to_x(values[k]) for k in network.free])
        away.append((done.x - truth) / np.sqrt(np.diag(done.covariance)))
        found = intervals90(done, problem.unknowns)
        held.append([i.low <= values[network.index(i.name)] <= i.high for i in found])
        print(f"  {seed + 1}: {np.mean(held[-1]):.3f} held; {done.message}", flush=True)
    cases = np.array(held)
    print(f"{cases.mean():.3f} of {cases.size} cases held; sd of (value - truth) / sd {np.std(away):.2f}")
    worst = np.argsort(cases.mean(axis=0))[:5]
    print("least: " + ", ".join(f"{problem.unknowns[k].name} {cases[:, k].mean():.2f}" for k in worst))


def _stepped(values: NDArray[np.float64], step: float) -> NDArray[np.float64]:
    return np.asarray(np.rint(values / step) * step)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--batches", type=int, default=12)
    parser.add_argument("--left-out", action="store_true")
    parser.add_argument("--coverage", type=int, default=0)
    parser.add_argument("--processes", type=int, default=2)
    given = parser.parse_args()
    machine = load_machine(MACHINE)
    batches = sample_year(machine, given.batches)
    with threadpool_limits(limits=1):
        if given.coverage:
            coverage(machine, batches, given.coverage)
        elif given.left_out:
            left_out(machine, batches, given.processes)
        else:
            seconds(machine, batches, given.repeats)


if __name__ == "__main__":
    main()
