"""How the cost per machine grows with the number of machines in one home, on made-up recordings (simulated).

    python -m benchmarks.fleet [--machines 1 10 100 1000] [--store URI] [--out FILE.md]

At each size the last machines are real: ingest of six short recordings, then a small training (two families, one
protocol) with tracking, promotion and report; their medians are noted. The others are stand-ins: the same batches in
the lake, runs in the tracking store and champion in the registry, written without computing anything. Look-ups are
timed in CPU seconds, which other programs of the computer do not change much. The exponent is the slope of log seconds
over log machines: 0 where a machine costs the same in any fleet. Nothing is asserted about time.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import median

import numpy as np
import pandas as pd

from data.batch import Batch
from data.machine import parse_machine
from models.selection.crossing import Plan
from pipelines import settings as settings_module
from pipelines.settings import Settings

LAST = 3  # machines at each size that are real
REPEATS = 3  # of a look-up
BATCHES, ROWS, STEP_S = 6, 40, 300
PLAN = Plan(("none",), ("zero", "ridge"), ("leave-batch-out",))
CPU = "all of it, CPU"
STEPS = ("ingest", "features", "grid", "trust", "track", "promote", "report", CPU)
MACHINE = """
machine: {name}
simulated: true
recording:
  files: ["*.csv"]
  time: {{column: time_s, unit: s}}
  step_s: 300
  max_gap_s: 900
  start_from_name: "%Y%m%d"
channels:
  front: {{role: temperature, unit: degC, resolution: 0.01, range: [-20, 80]}}
  bed: {{role: temperature, unit: degC, resolution: 0.01, range: [-20, 80]}}
  speed: {{role: driver, unit: rpm, resolution: 1, range: [0, 8000]}}
  z: {{role: error, unit: um, resolution: 0.1, range: [-300, 300]}}
"""


def write_machine(folder: Path, k: int) -> tuple[Path, Path]:
    """The k-th machine: its file and the folder of its recordings."""
    recordings = folder / f"m{k:05d}"
    recordings.mkdir(parents=True)
    for b in range(BATCHES):
        recording(k, b).to_csv(recordings / f"2025{b + 1:02d}14.csv", index=False)
    file = folder / f"m{k:05d}.yml"
    file.write_text(MACHINE.format(name=file.stem), encoding="utf-8")
    return file, recordings


def recording(k: int, batch: int) -> pd.DataFrame:
    """Two temperatures that follow the spindle, and an error that follows them, with noise."""
    rng = np.random.default_rng([k, batch])
    time_s = np.arange(ROWS) * STEP_S
    speed_rpm = 2000.0 * (1 + batch % 3)
    front = 20 + batch + speed_rpm / 400 * (1 - np.exp(-time_s / (2000 + 200 * batch)))
    bed = 20 + batch + (1 + batch % 2) * (1 - np.exp(-time_s / 9000)) + 0.2 * np.sin(time_s / (1500 + 200 * batch))
    z_um = 3.0 * (front - front[0]) - 1.5 * (bed - bed[0]) + rng.normal(0, 0.4, ROWS)
    table = {"time_s": time_s, "front": front, "bed": bed, "speed": speed_rpm, "z": z_um.round(1)}
    noise = {c: (table[c] + rng.normal(0, 0.02, ROWS)).round(2) for c in ("front", "bed")}
    return pd.DataFrame(table | noise)


def trained(folder: Path, k: int, configured: Settings) -> dict[str, float]:
    """Seconds of every step for the k-th machine."""
    from pipelines.caller import DirectCaller
    from pipelines.jobs.request import TrainRequest
    from pipelines.jobs.training import train

    file, recordings = write_machine(folder, k)
    begun_s = time.process_time()
    steps = train(TrainRequest(file, (recordings,), ("z",), PLAN), configured, DirectCaller()).seconds
    return steps | {CPU: time.process_time() - begun_s}


def stand_in(k: int, configured: Settings) -> float:
    """Put the k-th machine into lake, store and registry; the CPU seconds of the lake's part."""
    from pipelines.jobs.recordings import home_lake
    from pipelines.store import tracking
    from pipelines.store.runs import experiment_id

    name, (machine_yaml, tags) = f"m{k:05d}", (MACHINE, {"kind": "training", "target": "z", "simulated": "true"})
    machine = parse_machine(machine_yaml.format(name=name), name)
    batches = [
        Batch(name, f"2025{b + 1:02d}14", recording(k, b).assign(time_s=STEP_S * np.arange(ROWS, dtype=float)),
              machine.batch_channels(), start=pd.Timestamp(2025, b + 1, 14), simulated=True)
        for b in range(BATCHES)
    ]  # fmt: skip
    stored_s = seconds(lambda: home_lake().put_many(batches))
    client = tracking.open_store(configured)
    experiment = experiment_id(client, configured, name, "z", True)
    parent = client.create_run(experiment, tags=tags | {"machine": name})
    children = {"kind": "cell", "machine": name, "mlflow.parentRunId": parent.info.run_id}
    for run in (parent, *(client.create_run(experiment, tags=children) for _ in PLAN.families)):
        client.log_metric(run.info.run_id, "n_batches", BATCHES)
        client.set_terminated(run.info.run_id)
    client.create_registered_model(f"{name}-z", tags={"machine": name, "target": "z"})
    tags = {"machine": name, "target": "z", "outcome": "champion", "training_id": parent.info.run_id}
    made = client.create_model_version(f"{name}-z", f"file:///{name}", parent.info.run_id, tags=tags)
    client.set_registered_model_alias(f"{name}-z", "champion", made.version)
    return stored_s


def look_ups(machine: str, configured: Settings) -> dict[str, float]:
    """CPU seconds of reading one machine's and everybody's state, medians."""
    from pipelines.jobs.recordings import home_lake
    from pipelines.store import registry, tracking

    client = tracking.open_store(configured)
    calls: dict[str, Callable[[], object]] = {
        "all models (status)": lambda: registry.status(configured),
        "all trainings (status)": lambda: tracking.trainings(settings=configured),
        "one machine's trainings": lambda: tracking.trainings(machine, "z", configured),
        "one champion": lambda: registry.find_version(client, f"{machine}-z", "champion"),
        "lake: machines": lambda: home_lake().machines(),
        "lake: one machine's batches": lambda: home_lake().load_all(machine),
        "lake: two commits": lambda: restored(machine),
    }
    return {name: median(seconds(call) for _ in range(REPEATS)) for name, call in calls.items()}


def restored(machine: str) -> None:
    """Withdraw a batch and bring it back: two commits to the lake's manifest."""
    from pipelines.jobs.recordings import home_lake

    lake = home_lake()
    (batch_id,) = lake.batch_ids(machine)[:1]
    lake.withdraw(machine, [batch_id], "benchmark")
    lake.restore(machine, [batch_id])


def seconds(call: Callable[[], object]) -> float:
    """CPU seconds, which other programs of the computer do not change much."""
    begun_s = time.process_time()
    call()
    return time.process_time() - begun_s


def grown(sizes: Sequence[int], folder: Path, configured: Settings) -> pd.DataFrame:
    """Seconds by step (rows) and number of machines (columns), measured while the fleet grows."""
    columns: dict[int, dict[str, float]] = {}
    k = 0
    for size in sizes:
        stored_s = []
        while k < size - LAST:
            stored_s.append(stand_in(k, configured))
            k += 1
        runs = []
        while k < size:
            runs.append(trained(folder, k, configured))
            k += 1
        steps = {s: median(run.get(s, 0.0) for run in runs) for s in STEPS}
        lake = {"lake: store six batches": median(stored_s[-20:])} if stored_s else {}
        columns[size] = steps | look_ups(f"m{k - 1:05d}", configured) | lake
        print(f"{size} machines: " + ", ".join(f"{n} {s:.3f} s" for n, s in columns[size].items()), flush=True)
    return pd.DataFrame(columns)


def exponents(table: pd.DataFrame) -> pd.Series:
    """Slope of log seconds over log machines from ten machines on: the first one pays for imports and tables."""
    found = {}
    for name in table.index:
        known = {float(str(n)): s for n, s in table.loc[name].items() if int(str(n)) >= 10 and s > 0}
        x, y = np.log(list(known)), np.log(list(known.values()))
        found[name] = float(np.polyfit(x, y, 1)[0]) if len(known) > 1 else np.nan
    return pd.Series(found)


def as_markdown(table: pd.DataFrame) -> str:
    """The table with a column of exponents."""
    slope = exponents(table)
    head = "| seconds | " + " | ".join(f"{n} machines" for n in table) + " | exponent |"
    rows = [
        f"| {name} | " + " | ".join("" if np.isnan(v) else f"{v:.3f}" for v in table.loc[name])
        + f" | {slope[name]:.2f} |"
        for name in table.index
    ]  # fmt: skip
    return "\n".join([head, "|---" * (table.shape[1] + 2) + "|", *rows])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--machines", type=int, nargs="+", default=[1, 10, 100], help="sizes, such as 1 10 100 1000")
    parser.add_argument("--store", help="a tracking store; default: SQLite in the home")
    parser.add_argument("--out", type=Path, help="where the table goes as Markdown")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="thermodrift-fleet-") as scratch:
        os.environ["THERMODRIFT_HOME"] = str(Path(scratch) / "home")
        os.chdir(scratch)
        configured = settings_module.load()
        rule = configured.promotion.model_copy(update={"protocols": {"leave-batch-out": 1.0}})
        configured = replace(configured, store_uri=given.store or configured.store_uri, promotion=rule)
        table = grown(sorted(given.machines), Path(scratch), configured)
    text = as_markdown(table)
    print(text)
    if given.out:
        given.out.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
