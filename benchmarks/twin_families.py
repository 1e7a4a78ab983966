"""How well the twin predicts next to data-driven families, on the simulated sample year: few batches, seasons, sensors.

    python benchmarks/twin_families.py [--out RESULTS.jsonl] [--draws 6] [--files true,moved,coarse] [--channels z,y,x]

Every family learns from the same batches and is judged on batches that it never saw: each batch left out, each season
left out, and 1, 2, 3, 5, 10 random batches to learn from and all others to predict. The twin's machine file comes in
three states: `true` has the values that the recordings were simulated with, so its structure and its numbers are
right; `moved` has every free value drawn anew from its prior; `coarse` also lacks grease, preload, ventilation and the
speed's own shift. Figures are S in µm (residual standard deviation of a batch). Finished parts in RESULTS are not run
again. Nothing is asserted.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml
from threadpoolctl import threadpool_limits

from data.batch import Batch
from data.machine import Machine, load_machine, parse_machine
from data.recording import read_batches
from features.design import Design
from models.base import Family
from models.families import FAMILIES
from models.metrics import batch_scores
from models.protocols import Fold, leave_batch_out, leave_season_out
from plants.sample.sample_year import write_sample_year
from twin.calibration.calibrated_file import Update, with_values
from twin.compile import compile_network

MACHINE_FILE = Path(__file__).parent.parent / "machines" / "sample_vmc.yml"
SENSORS = {4: ("front", "motor", "column_front", "bed"), 10: ()}  # a control's few, and all
FEW = (1, 2, 3, 5, 10)
DATA_DRIVEN = (("zero", 0), ("mean_curve", 0), ("thermal_exponential", 0), ("mlr", 4), ("mlr", 10), ("ridge", 4),
               ("ridge", 10))  # fmt: skip
PHYSICS = (("twin", 0), ("twin_residual", 4), ("twin_residual", 10), ("twin_kalman", 4), ("twin_kalman", 10))
COARSE_LACKS = ("front_preload", "rear_preload", "front_grease", "rear_grease", "spinning", "speed_shift")


def machines(seed: int = 1) -> dict[str, Machine]:
    """The machine file in its three states."""
    text, rng = MACHINE_FILE.read_text(encoding="utf-8"), np.random.default_rng(seed)
    network = compile_network(load_machine(MACHINE_FILE))
    updates = {}
    for k in network.free:
        p = network.parameters[k]
        value = float(np.clip(p.from_x(p.to_x(p.value) + p.spread * rng.normal()), p.low, p.high))
        updates[p.name] = Update(p, value, (value, value))
    moved = _without_priors(yaml.safe_load(with_values(text, updates, str(MACHINE_FILE))))
    coarse = json.loads(json.dumps(moved))
    for name in COARSE_LACKS:
        del coarse["twin"]["mechanisms"][name]
    read = {name: parse_machine(yaml.safe_dump(raw, sort_keys=False), name) for name, raw in
            (("moved", moved), ("coarse", coarse))}  # fmt: skip
    return {"true": load_machine(MACHINE_FILE), **read}


def _without_priors(part: Any) -> Any:
    """A moved value is the prior's new centre: what the file keeps of the old one would give the truth away."""
    if not isinstance(part, dict):
        return [_without_priors(p) for p in part] if isinstance(part, list) else part
    hidden = {"prior", "interval90"} if "value" in part else set()
    return {k: _without_priors(v) for k, v in part.items() if k not in hidden}


def protocols(batches: list[Batch], draws: int) -> dict[str, list[Fold]]:
    """Training and tested batches by protocol; random draws are the same for every family."""
    every, rng = range(len(batches)), np.random.default_rng(0)
    out = {"batch left out": leave_batch_out(batches), "season left out": leave_season_out(batches)}
    for n in FEW:
        drawn = [tuple(sorted(rng.choice(len(batches), n, replace=False).tolist())) for _ in range(draws)]
        out[f"{n} to learn from"] = [Fold(str(d), d, tuple(k for k in every if k not in d)) for d in drawn]
    return out


def judged(family: Family, design: Design, folds: list[Fold]) -> list[list[float]]:
    """S in µm of every tested batch, by fold."""
    out = []
    for model, fold in zip(family.fit_folds(design, [f.train for f in folds]), folds, strict=True):
        predicted = model.predict_design(design, fold.test)
        out.append([
            float(batch_scores(design.y_um[design.rows(k)], p[:, None])["S_um"][0])
            for k, p in zip(fold.test, predicted, strict=True)
        ])  # fmt: skip
    return out


def work(args: argparse.Namespace, batches: list[Batch]) -> Iterator[tuple[dict[str, object], Machine]]:
    """Every part to run, data-driven families first."""
    files = machines()
    for protocol in protocols(batches, args.draws):
        for channel in args.channels.split(","):
            for key, sensors in DATA_DRIVEN:
                yield dict(file="-", protocol=protocol, channel=channel, family=key, sensors=sensors), files["true"]
    for name in args.files.split(","):
        for protocol in protocols(batches, args.draws):
            for channel in args.channels.split(","):
                for key, sensors in PHYSICS:
                    yield dict(file=name, protocol=protocol, channel=channel, family=key, sensors=sensors), files[name]


def table(rows: list[dict[str, object]], channel: str) -> pd.DataFrame:
    """One error channel: a row per family, sensors and file; mean ± sd over batches, or median [range] over draws."""
    out: dict[tuple[object, ...], dict[str, str]] = {}
    for row in rows:
        if row["channel"] != channel:
            continue
        S = row["S_um"]
        assert isinstance(S, list)
        if str(row["protocol"]).endswith("left out"):
            flat = np.concatenate([np.array(s) for s in S])
            text = f"{flat.mean():.2f} ± {flat.std(ddof=1):.2f}"
        else:
            means = np.array([np.mean(s) for s in S])
            text = f"{np.median(means):.2f} [{means.min():.2f}–{means.max():.2f}]"
        out.setdefault((row["family"], row["sensors"] or "", row["file"]), {})[str(row["protocol"])] = text
    index = pd.MultiIndex.from_tuples(out, names=["family", "sensors", "file"])
    return pd.DataFrame(list(out.values()), index=index).fillna("")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("var/twin_families.jsonl"))
    parser.add_argument("--draws", type=int, default=6)
    parser.add_argument("--files", default="true,moved,coarse")
    parser.add_argument("--channels", default="z,y,x")
    args = parser.parse_args()
    args.out.parent.mkdir(parents=True, exist_ok=True)
    rows = [json.loads(line) for line in args.out.read_text().splitlines()] if args.out.exists() else []
    keys = ("file", "protocol", "channel", "family", "sensors")
    finished = {tuple(r[k] for k in keys) for r in rows}
    with tempfile.TemporaryDirectory() as folder, threadpool_limits(limits=1):
        machine = load_machine(MACHINE_FILE)
        batches = [b for f in write_sample_year(Path(folder)) for b in read_batches(f, machine)]
        folds = protocols(batches, args.draws)
        sensors = machine.names("temperature", "ambient")
        for part, described in work(args, batches):
            if tuple(part[k] for k in keys) in finished:
                continue
            inputs = SENSORS.get(int(str(part["sensors"]))) or sensors
            design = Design.build(batches, inputs, str(part["channel"]), described)
            begun = time.perf_counter()
            S = judged(FAMILIES[str(part["family"])](), design, folds[str(part["protocol"])])
            rows.append({**part, "S_um": S, "seconds": round(time.perf_counter() - begun, 2)})
            with args.out.open("a", encoding="utf-8") as file:
                file.write(json.dumps(rows[-1]) + "\n")
    print("simulated sample year, 30 batches; S in µm on batches never seen: mean ± sd over batches, or median [range]")
    print(f"over {args.draws} random draws of the batches to learn from")
    for channel in args.channels.split(","):
        print(f"\nerror {channel}\n{table(rows, channel).to_string()}")


if __name__ == "__main__":
    main()
