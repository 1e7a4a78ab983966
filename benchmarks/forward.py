"""Models of earlier runs on later runs: a lathe, a spindle, the sample year and two simulated machines.

    python -m benchmarks.forward [--recordings FOLDER] [--families ridge,lag_dictionary]
                                 [--machines lathe,spindle,year,volumes,elements] [--protocols forward,leave-batch-out]
    python -m benchmarks.forward --records

All temperatures and ambients that every run has are inputs; drivers are there for the families that use them. Per
machine, error channel, protocol and family: mean S ± std over the predicted runs and the worst run, in µm, the time of
all folds, and for `forward` the mean S over the odd blocks (on which settings of families may be chosen) and over the
even blocks (on which they are confirmed). `step` is `forward` with blocks of one run: the last twelve runs of a
machine with at least 24, each predicted by a model of all runs before it. FOLDER holds lathe_gv1203 and spindle_fl;
what is missing is skipped. Nothing is asserted. `--records` prints for every family its mean S of later runs over that
of the best one, the geometric mean over the kinds of machine but the lathe: what `models.selection.loss.RECORDS` holds.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks.beyond import ROOT, recorded
from data.arrays import Array
from data.batch import Batch
from data.errors import InputError
from data.machine import Machine, load_machine
from data.recording import read_batches
from features.design import Design
from models.families import FAMILIES
from models.metrics import residual_std_um
from models.protocols import PROTOCOLS, Fold, folds_of
from plants.sample.sample_year import write_sample_year
from thermodrift_exam.plants.plant import draw

Runs = tuple[Machine, list[Batch]]
STEP = "step"
_STEPS, _FEWEST_FOR_STEPS = 12, 24
_PLANTS = {"volumes": 11, "elements": 12}  # seeds
FAMILIES_SHOWN = ("zero", "mean_curve", "ridge", "transfer_function", "lag_dictionary")
PROTOCOLS_SHOWN = ("forward", STEP, "leave-season-out", "leave-batch-out")


def sample_year() -> Runs:
    machine = load_machine(ROOT / "machines" / "sample_vmc.yml")
    with tempfile.TemporaryDirectory() as folder:
        return machine, [b for f in write_sample_year(Path(folder)) for b in read_batches(f, machine)]


def plant(kind: str) -> Runs:
    """A simulated machine of 24 runs through a year, whose friction scatters as the sample year's does."""
    case = draw(_PLANTS[kind], plant=kind, batches=24, friction_scatter=0.15, everyday=True)
    return case.machine, case.batches


def machines(folder: Path) -> dict[str, Callable[[], Runs]]:
    return {
        "lathe": lambda: recorded("lathe_gv1203", folder / "lathe_gv1203"),
        "spindle": lambda: recorded("spindle_fl", folder / "spindle_fl"),
        "year": sample_year,
        **{kind: lambda kind=kind: plant(kind) for kind in _PLANTS},  # type: ignore[misc]
    }


def in_time(batches: Sequence[Batch]) -> list[Batch]:
    if any(b.start is None for b in batches):
        return list(batches)
    return sorted(batches, key=lambda b: (b.start, b.batch_id))


def folds(protocol: str, batches: Sequence[Batch]) -> list[Fold]:
    """Folds of a protocol over batches in order of time."""
    if protocol != STEP:
        return folds_of(protocol, batches)
    n = len(batches)
    first = n - _STEPS if n >= _FEWEST_FOR_STEPS else n
    return [Fold(batches[k].batch_id, tuple(range(k)), (k,)) for k in range(first, n)]


def block_scores(key: str, design: Design, parts: Sequence[Fold]) -> list[Array]:
    """S in µm of every predicted run, by fold."""
    fitted = FAMILIES[key]().fit_folds(design, [f.train for f in parts])
    predicted = fitted[0].predict_folds(design, fitted, [f.test for f in parts])
    return [
        np.array([residual_std_um(design.y_um[design.rows(k)] - p) for k, p in zip(f.test, own, strict=True)])
        for f, own in zip(parts, predicted, strict=True)
    ]


def table(name: str, machine: Machine, batches: Sequence[Batch], families: Iterable[str], protocol: str) -> None:
    """One line per error channel and family."""
    parts = folds(protocol, batches)
    if not parts:
        return
    print(f"\n{name}, {protocol}: {len(parts)} folds")
    print(f"{'error':8} {'family':18} {'S µm':>15} {'worst':>7} {'odd':>7} {'even':>7} {'s':>6}")
    thermal = batches[0].names("temperature", "ambient")
    inputs = [n for n in thermal if all(np.isfinite(b.masked(n)).any() for b in batches)]
    for target in batches[0].names("error"):
        design = Design.build(batches, inputs, target, machine)
        for key in families:
            start = time.perf_counter()
            try:
                blocks = block_scores(key, design, parts)
            except InputError as error:
                print(f"{target:8} {key:18} {error}")
                continue
            S_um = np.concatenate(blocks)
            line = f"{target:8} {key:18} {S_um.mean():7.2f} ± {S_um.std(ddof=1):5.2f} {S_um.max():7.1f}"
            halves = [np.concatenate(blocks[half::2]).mean() for half in (0, 1)]
            shown = "".join(f" {h:7.2f}" for h in halves) if protocol.startswith("forward") else " " * 16
            print(f"{line}{shown} {time.perf_counter() - start:6.1f}", flush=True)


def records(known: dict[str, Callable[[], Runs]]) -> None:
    """Mean S forward of every family over that of the best, by kind of machine and altogether."""
    ratios: dict[str, dict[str, float]] = {}
    for name in ("spindle", "year", *_PLANTS):
        machine, batches = known[name]()
        batches = in_time(batches)
        thermal = [n for n in batches[0].names("temperature", "ambient") if all(n in b.table for b in batches)]
        inputs = [n for n in thermal if all(np.isfinite(b.masked(n)).any() for b in batches)]
        logs: dict[str, list[float]] = {}
        for target in batches[0].names("error"):
            design, own = Design.build(batches, inputs, target, machine), {}
            for key, family in FAMILIES.items():
                if family.needs_position or family.needs_twin or family.combines:
                    continue
                with suppress(InputError):
                    own[key] = float(np.concatenate(block_scores(key, design, folds("forward", batches))).mean())
            for key, S_um in own.items():
                logs.setdefault(key, []).append(float(np.log(S_um / min(own.values()))))
        for key, values in logs.items():
            ratios.setdefault(key, {})[name] = float(np.exp(np.mean(values)))
    for key, own in sorted(ratios.items(), key=lambda item: float(np.mean(np.log(list(item[1].values()))))):
        overall = float(np.exp(np.mean(np.log(list(own.values())))))
        print(f"{key:24} {overall:5.2f}   {', '.join(f'{k} {v:.2f}' for k, v in own.items())}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument("--families", default=",".join(FAMILIES_SHOWN))
    parser.add_argument("--machines", default="lathe,spindle,year,volumes,elements")
    parser.add_argument("--protocols", default=",".join(PROTOCOLS_SHOWN), help=f"{STEP}, {', '.join(PROTOCOLS)}")
    parser.add_argument("--records", action="store_true", help="what every family reaches next to the best")
    args = parser.parse_args()
    with threadpool_limits(limits=1):
        known = machines(args.recordings)
        if args.records:
            records(known)
            return
        for name in args.machines.split(","):
            try:
                machine, batches = known[name]()
            except InputError as error:
                print(f"\n{name}: skipped ({error})")
                continue
            for protocol in args.protocols.split(","):
                table(name, machine, in_time(batches), args.families.split(","), protocol)


if __name__ == "__main__":
    main()
