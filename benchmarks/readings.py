"""What readings of a touch probe are worth: later runs with and without them, by model and schedule.

    python -m benchmarks.readings [--data ../shared/data] [--families ridge,transfer_function,lag_dictionary] [--plants]

Blocks of later runs (`models.protocols.forward`), all temperature inputs; ridge also with lags of 30 and 120 min. For
every machine, axis and model the mean and standard deviation over runs of S in µm: free-running, and with one reading a
shift (the first hour's end) and one an hour, by a random walk of the offset (the last residual is held) and by
`models.selection.updating`. The second and fourth block are shown apart from the others. The form of the updater was
chosen on the sample year, the spindle and plants, not on the lathe. Then S by the number of readings, and seconds.

The sample year and the sample lathe are simulated; the lathe and the spindle are recordings in `--data`, left out where
that folder is missing; `--plants` adds three drawn plants.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from benchmarks.grid import sample_batches
from data.batch import Batch
from data.checks import check_batch, check_machine, usable_channels
from data.machine import load_machine
from data.recording import read_batches
from features.design import Design
from features.rises import temperature_inputs
from models.families import FAMILIES
from models.metrics import residual_std_um
from models.protocols import forward
from models.selection.updating import COUNTS, SCHEDULES, Track, Updater, out_of_fold, scores
from thermodrift_exam.plants.plant import draw
from thermodrift_exam.plants.types.lathe_axis import write_sample_axis

MACHINES = Path(__file__).parent.parent / "machines"
LAGS = ("lag30min", "lag120min")
SHOWN = {"one a shift": "shift", "one reading an hour": "hour"}
CONFIRMED = (1, 3)  # blocks that nothing was chosen on


def recorded(name: str, files: Sequence[Path]) -> list[Batch]:
    """Batches of recordings, checked as at ingest."""
    machine = load_machine(MACHINES / f"{name}.yml")
    batches = [b for f in files for b in read_batches(f, machine)]
    return check_machine([b.with_findings(check_batch(b, machine)) for b in batches], machine)


def cases(data: Path, with_plants: bool) -> Iterator[tuple[str, list[Batch], tuple[str, ...]]]:
    """Name, batches and error channels of every machine."""
    if (data / "lathe_gv1203").exists():
        batches = recorded("lathe_gv1203", sorted((data / "lathe_gv1203").glob("20*.csv")))
        yield "lathe", batches, ("disp_x", "disp_z")
    with tempfile.TemporaryDirectory() as folder:
        yield "sample year", sample_batches(Path(folder)), ("x", "y", "z")
    if (data / "spindle_fl").exists():
        yield "spindle", recorded("spindle_fl", sorted((data / "spindle_fl").glob("*.csv"))), ("ch1", "ch3", "ch5")
    with tempfile.TemporaryDirectory() as folder:
        batches = recorded("sample_lathe", write_sample_axis(Path(folder), batches=24))
    yield "sample lathe", batches, ("x_spindle", "z_spindle")
    for seed, kind in ((11, "volumes"), (12, "elements"), (13, "volumes")) if with_plants else ():
        drawn = draw(seed, plant=kind, batches=24, everyday=True, friction_scatter=0.15).batches
        yield f"plant {seed}", sorted(drawn, key=lambda b: str(b.start)), ("x", "z")


def judged(batches: list[Batch], target: str, family: str, lags: bool) -> tuple[np.ndarray, list[list[float]], float]:
    """Per run [block, S free, then S held, S updated and coverage by schedule], S by count of readings, seconds."""
    inputs, _ = usable_channels(batches, temperature_inputs(batches))
    inputs = inputs + tuple(f"{i}@{lag}" for i in inputs for lag in LAGS if lags)
    design = Design.build(batches, inputs, target)
    rows, curve, seconds = [], [], 0.0
    for block, fold in enumerate(forward(batches)):
        learned_on, fitted = out_of_fold(design, family, fold.train), FAMILIES[family]().fit_design(design, fold.train)
        predicted = fitted.predict_design(design, fold.test)
        tracks = [Track.of(design, k, p) for k, p in zip(fold.test, predicted, strict=True)]
        start = time.perf_counter()
        updater = Updater.learn(learned_on)
        for track in tracks:
            found: list[float] = [block, float(residual_std_um(track.residual_um))]
            for name in SHOWN:
                _, S_um, held_S_um, _, coverage = scores(updater, track, SCHEDULES[name])
                found += [held_S_um, S_um, coverage]
            rows.append(found)
            curve.append([scores(updater, track, n)[1] for n in COUNTS])
        seconds += time.perf_counter() - start
    return np.array(rows), curve, seconds / len(rows)


def line(values: np.ndarray) -> str:
    spread = np.std(values, axis=0, ddof=1) if len(values) > 1 else np.full(values.shape[1], np.nan)
    return " ".join(f"{m:6.2f} ± {s:5.2f}" for m, s in zip(np.mean(values, axis=0), spread, strict=True))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path(__file__).parents[2] / "shared" / "data")
    parser.add_argument("--families", default="ridge,transfer_function,lag_dictionary")
    parser.add_argument("--plants", action="store_true")
    args = parser.parse_args()
    print(f"{'machine, axis, model, blocks':52}{'free':>14}{'shift held':>15}{'shift':>15}{'hour held':>15}{'hour':>15}"
          f"  coverage of 90 %: shift, hour")  # fmt: skip
    for name, batches, targets in cases(args.data, args.plants):
        for target in targets:
            for family in args.families.split(","):
                table, curve, seconds = judged(batches, target, family, lags=family == "ridge")
                label = f"{name} {target} {family}{' with lags' if family == 'ridge' else ''}"
                confirmed = np.isin(table[:, 0], CONFIRMED)
                for which, some in (("others", ~confirmed), ("2 and 4", confirmed)):
                    shown = line(table[some][:, [1, 2, 3, 5, 6]])
                    covered = np.nanmean(table[some][:, [4, 7]], axis=0)
                    print(f"{label + ', ' + which:52}{shown}  {covered[0]:.2f} {covered[1]:.2f}")
                by_count = " ".join(f"{n}: {S_um:.2f}" for n, S_um in zip(COUNTS, np.mean(curve, axis=0), strict=True))
                print(f"{'':4}S by number of readings, evenly: {by_count}; {1e3 * seconds:.0f} ms a run", flush=True)


if __name__ == "__main__":
    main()
