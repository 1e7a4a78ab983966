"""The lag dictionary next to ridge, PCR and MLR: a lathe's summer, a spindle's two days, the simulated year.

    python -m benchmarks.beyond [--recordings FOLDER] [--sensors 6] [--selectors pca_elimination,fcgc,kmedoids]

Every figure is nested: selectors, penalties and weights see the training batches of a fold only. Mean S ± std over
the left-out batches in µm, the median, and how often a 90 % interval held what was recorded. A batch that the data
checks call unexplained (a warning, no mask) is counted, and the table also gives the mean without it. FOLDER holds
lathe_gv1203 and spindle_fl; what is missing is skipped. Nothing is asserted.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from data.batch import Batch
from data.checks import check_machine, checked
from data.machine import Machine, load_machine
from data.recording import read_batches, recording_files
from models.selection.crossing import Plan
from models.selection.grid import run_grid
from plants.sample.sample_year import write_sample_year

ROOT = Path(__file__).parent.parent
RECORDED = (
    ("lathe_gv1203", "leave-batch-out", ("disp_x", "disp_z")),
    ("spindle_fl", "leave-speed-out", ("ch1", "ch2", "ch3", "ch4", "ch5")),
)
HEAD = f"{'error':8} {'family':15} {'selector':18} {'points':>6} {'batches':>7} {'S µm':>15} {'median':>7} {'90 %':>5}"


def recorded(name: str, folder: Path) -> tuple[Machine, list[Batch]]:
    """Every run in a folder, with the findings of all checks."""
    machine = load_machine(ROOT / "machines" / f"{name}.yml")
    files, _ = recording_files(folder, machine)
    batches = [b for f in files for b in read_batches(f, machine)]
    return machine, check_machine([checked(b, machine) for b in batches], machine)


def table(batches: Sequence[Batch], target: str, plan: Plan, machine: Machine | None) -> None:
    """One line a cell."""
    unexplained = {b.batch_id for b in batches for f in b.findings if f.check == "unexplained" and f.channel == target}
    start = time.perf_counter()
    result = run_grid(batches, [target], plan, machine)[target][1]
    cell = ["selector", "family", "n_tsp"]
    for (selector, family, n), rows in result.scores.groupby(cell, sort=False):
        S_um = rows["S_um"].to_numpy()
        sound = S_um[~rows["batch_id"].isin(unexplained).to_numpy()]
        line = (
            f"{target:8} {family:15} {selector:18} {n:6d} {len(S_um):7d} {S_um.mean():7.2f} ± {S_um.std(ddof=1):5.2f}"
        )
        line += f" {np.median(S_um):7.2f} {100 * rows['coverage90'].mean():5.0f}"
        if len(sound) < len(S_um):
            line += f"   without {', '.join(sorted(unexplained))}: {sound.mean():.2f} ± {sound.std(ddof=1):.2f}"
        print(line, flush=True)
    print(f"{'':8} {time.perf_counter() - start:.0f} s", flush=True)


def compare(
    batches: Sequence[Batch], targets: Sequence[str], protocol: str, machine: Machine | None, args: argparse.Namespace
) -> None:
    """Each error channel with all sensors, and with few of them by the named selectors."""
    print(f"\n{batches[0].machine}, {protocol}\n{HEAD}")
    few = (args.sensors,)
    for target in targets:
        families = ("zero", "pcr", "mlr", "ridge", "lag_dictionary")
        table(batches, target, Plan(("none",), families, (protocol,)), machine)
        selectors = tuple(args.selectors.split(","))
        table(batches, target, Plan(("fcgc",), ("mlr",), (protocol,), few), machine)
        chosen = Plan(selectors, ("ridge", "lag_dictionary"), (protocol,), few, few)
        table(batches, target, chosen, machine)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--recordings", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument("--sensors", type=int, default=6)
    parser.add_argument("--selectors", default="pca_elimination,fcgc,kmedoids")
    args = parser.parse_args()
    with threadpool_limits(limits=1):
        for name, protocol, targets in RECORDED:
            if not (args.recordings / name).is_dir():
                print(f"\n{name}: no recordings in {args.recordings}, skipped")
                continue
            machine, batches = recorded(name, args.recordings / name)
            compare(batches, targets, protocol, machine, args)
        with tempfile.TemporaryDirectory() as folder:
            machine = load_machine(ROOT / "machines" / "sample_vmc.yml")
            batches = [b for f in write_sample_year(Path(folder)) for b in read_batches(f, machine)]
        compare(batches, ("x", "y", "z"), "leave-batch-out", None, args)


if __name__ == "__main__":
    main()
