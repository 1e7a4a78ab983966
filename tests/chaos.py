"""Kill commands at random moments and see what is left: `python -m tests.chaos [--kills 200] [--seed S] [--only …]`.

Each kill is SIGKILL to the whole process group of an ingest, a training, a promotion, a scheduled retraining or a
compensation on a small machine; every second time also to processes that have a group of their own, as in a power cut.
Then the lake has to be whole, `status` has to work, the same command again has to
succeed with the numbers of an undisturbed run, and the registry has to have no half-made version. Each kill prints a
line; the home after one that broke something stays in OUT.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import importlib
import json
import os
import random
import runpy
import shutil
import signal
import sqlite3
import statistics
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from tests.toys.one_round import write_fleet
from tests.toys.signalled import ROOT, Command
from tests.toys.small_year import write_machine, write_year

NAME, TARGET, BATCHES = "killed", "z", 11  # enough for a champion
MODEL = f"{NAME}-{TARGET}"
FAMILIES = ("zero", "mlr")
LOADED = (
    "pipelines.cli",
    "pipelines.jobs.training",
    "pipelines.fleet.watching",
    "pipelines.jobs.compensating",
    "pyarrow.parquet",
)
WAIT_S = 600.0  # for a command on a busy computer
ORPHANS_S = 15.0  # for workers, servers and the processes of a fleet to end without their parent, on a busy computer
SAME = 1e-9  # relative difference of numbers that are the same


class Work:
    """The folder of a chaos run: recordings, template homes, and the home that is killed in."""

    def __init__(self, out: Path) -> None:
        self.out, self.home = out.resolve(), out.resolve() / "home"
        self.out.mkdir(parents=True, exist_ok=True)
        self.machine, self.recordings, self.first = (self.out / n for n in ("m.yml", "in", "first"))
        self.references: dict[tuple[str, str], tuple[float, dict[str, Any]]] = {}
        if not self.machine.exists():
            write_year(self.recordings, BATCHES)
            (self.recordings / "20251214.csv").write_bytes(b"")  # goes to quarantine
            write_year(self.first, BATCHES - 1)
            self._samples()
            write_machine(self.machine, NAME)
        for folder in (self.recordings, self.first):
            for file in folder.iterdir():
                os.utime(file, (time.time() - 3600,) * 2)  # an ingest looks twice at what is new

    def _samples(self) -> None:
        import pandas as pd

        table = pd.read_csv(self.recordings / "20250714.csv")
        fine = pd.DataFrame({"time_s": np.arange(0.0, table["time_s"].iloc[-1], 2.0)})
        for name in ("front", "bed", "room", "speed"):
            fine[name] = np.interp(fine["time_s"], table["time_s"], table[name]).round(3)
        fine.to_csv(self.out / "samples.csv", index=False)

    def template(self, name: str) -> Path:
        """A home made by undisturbed commands, once."""
        folder = self.out / f"template-{name}"
        if not folder.exists():
            shutil.rmtree(self.home, ignore_errors=True)
            self.home.mkdir()
            TEMPLATES[name](self)
            self.home.rename(folder)  # paths inside the store name `home`: a template is copied there again
        return folder

    def renew(self, template: str) -> None:
        """The home as the template has it."""
        source = self.template(template)
        shutil.rmtree(self.home, ignore_errors=True)
        shutil.copytree(source, self.home)

    def run(self, arguments: Sequence[object], module: str = "pipelines.cli") -> tuple[int, str]:
        """Exit code and output of a command that is not killed: a fork of this process, whose imports it shares."""
        for name in LOADED:
            importlib.import_module(name)
        log = self.out / "undisturbed.log"
        sys.stdout.flush()
        if not (pid := os.fork()):
            become(self.home, log, [module, *map(str, arguments)])
        end_s = time.monotonic() + WAIT_S
        while not (ended := os.waitpid(pid, os.WNOHANG))[0]:
            if time.monotonic() > end_s:
                os.killpg(pid, signal.SIGKILL)
            time.sleep(0.02)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(pid, signal.SIGKILL)
        return os.waitstatus_to_exitcode(ended[1]), log.read_text(encoding="utf-8", errors="replace")

    def must(self, arguments: Sequence[object], module: str = "pipelines.cli") -> None:
        code, output = self.run(arguments, module)
        if code != 0:
            raise RuntimeError(f"undisturbed {arguments}: exit code {code}\n{output}")


def become(home: Path, log: Path, argv: list[str], stdin: int | None = None) -> NoReturn:
    """Turn a forked process into a command, which ends it; it reads `stdin` and has no other file of its parent."""
    os.setsid()
    os.chdir(ROOT)
    if stdin is not None:
        os.dup2(stdin, 0)
        os.closerange(3, 1024)
        sys.stdin = os.fdopen(0, encoding="utf-8", closefd=False)
    handle = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
    os.dup2(handle, 1)
    os.dup2(handle, 2)
    # a test captures the ones before
    sys.stdout, sys.stderr = (os.fdopen(fd, "w", encoding="utf-8", closefd=False) for fd in (1, 2))
    os.environ |= {"THERMODRIFT_HOME": str(home), "TMPDIR": str(home.parent)}
    tempfile.tempdir = None
    sys.argv = argv
    code = 0
    try:
        runpy.run_module(argv[0], run_name="__main__", alter_sys=True)
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc()
        code = 1
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def training(w: Work, recordings: Path, *more: object) -> list[object]:
    return ["train", "--machine", w.machine, "--recordings", recordings, "--channels", TARGET, "--selectors", "none",
            "--families", ",".join(FAMILIES), "--direct", *more]  # fmt: skip


def promotion(w: Work) -> list[object]:
    return ["promote", finished_trainings(w.home)[0], "--machine", w.machine]


TEMPLATES: dict[str, Callable[[Work], None]] = {
    "empty": lambda w: None,
    "champion": lambda w: w.must(training(w, w.first)),
    "tracked": lambda w: w.must(training(w, w.recordings, "--no-promote")),
}


@dataclass(frozen=True)
class Case:
    """A command, and the homes that it begins in, in turn."""

    templates: tuple[str, ...]
    arguments: Callable[[Work], list[object]]
    module: str = "pipelines.cli"


CASES: dict[str, Case] = {
    "ingest": Case(("empty",), lambda w: ["ingest", w.recordings, "--machine", w.machine]),
    "train": Case(("empty", "champion"), lambda w: training(w, w.recordings)),
    "promote": Case(("tracked",), promotion),
    "schedule": Case(("champion", "empty"), lambda w: [write_fleet(w.out / "fleet.yml", w.machine, w.recordings)],
                     "tests.toys.one_round"),
    "compensate": Case(
        ("champion",),
        lambda w: ["compensate", f"models:/{MODEL}@champion", "--from", w.out / "samples.csv", "--to",
                   w.home / "corrections.csv", "--replay", "--sample-s", "2", "--state", w.home / "state.json"],
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Kill:
    """One kill: `moment_s` after the start, `share` of an undisturbed run's time, `phase` the last line before it."""

    command: str
    template: str
    moment_s: float
    share: float
    phase: str
    wrong: tuple[tuple[str, str], ...]  # invariants and what was seen


def finished_trainings(home: Path) -> list[str]:
    """Ids of trainings that the store has as finished, newest first; read without any of the program's own code."""
    file = home / "mlflow.db"
    if not file.exists():
        return []
    with contextlib.closing(sqlite3.connect(f"file:{file}?mode=ro", uri=True)) as store:
        rows = store.execute(
            "select r.run_uuid from runs r join tags t on t.run_uuid = r.run_uuid where t.key = 'kind' and "
            "t.value = 'training' and r.status = 'FINISHED' order by r.start_time desc"
        )
        return [str(row[0]) for row in rows]


def lake_trouble(home: Path) -> list[str]:
    """What is wrong in the lake, batch by batch and in the quarantine; whole batches only, each with its hash."""
    from data.errors import InputError, WorkError
    from data.lake import Lake

    lake, found = Lake(home / "lake"), []
    for machine in lake.machines(withdrawn=True):
        for batch_id, versions in lake.contents(machine).items():
            for v in versions:
                try:
                    lake.load(machine, batch_id, v.version)
                except (InputError, WorkError) as error:
                    found.append(str(error))
    for folder in (home / "lake" / "_quarantine").glob("machine=*"):
        for entry in lake.quarantined(folder.name.partition("=")[2]):
            copied = entry.copy
            if copied is None or hashlib.sha256(copied.read_bytes()).hexdigest() != entry.sha256:
                found.append(f"quarantine of {entry.name}: its copy is not what the log says")
    return found


def current_trouble(home: Path) -> list[str]:
    """What plain readers would see wrong: every current file is the newest version of its batch."""
    import pyarrow.parquet as pq

    from data.lake import Lake

    lake, found = Lake(home / "lake"), []
    for machine in lake.machines():
        files = {pq.ParquetFile(f).read(columns=["batch"])["batch"][0].as_py(): f
                 for f in (home / "lake" / f"machine={machine}").glob("*/*.parquet")}  # fmt: skip
        if set(files) != set(lake.batch_ids(machine)):
            found.append(f"current files of {sorted(files)}, the lake has {lake.batch_ids(machine)}")
    return found


def facts(home: Path) -> dict[str, Any]:
    """What the home holds: lake, runs, versions, champion and its predictions; called in a process of its own."""
    from data.lake import Lake

    lake = Lake(home / "lake")
    held = {b: [v.digest for v in vs] for m in lake.machines() for b, vs in lake.contents(m).items()}
    out: dict[str, Any] = {
        "lake": held, "lake_trouble": lake_trouble(home) + current_trouble(home),
        "quarantine": sorted({(e.name, e.sha256) for e in lake.quarantined(NAME)}),
    }  # fmt: skip
    if (home / "mlflow.db").exists():
        out |= _store_facts(home)
    state, corrections = home / "state.json", home / "corrections.csv"
    if state.exists():
        out["state"] = sorted(json.loads(state.read_text(encoding="utf-8")))
    if corrections.exists():
        out["corrections"] = _corrections(corrections)
    return out


def _corrections(file: Path) -> dict[str, Any]:
    import pandas as pd

    table = pd.read_csv(file)
    offset = next(c for c in table.columns if TARGET in c and "offset" in c)
    last = table.tail(1).iloc[0]
    return {"time_s": float(last["time_s"]), "offset_um": float(last[offset])}


def _store_facts(home: Path) -> dict[str, Any]:
    from pipelines import settings
    from pipelines.store import audit, model_store, registry, tracking
    from pipelines.store.runs import model_versions

    configured = settings.load()
    client = tracking.open_store(configured)
    ids = [e.experiment_id for e in client.search_experiments()]
    running = client.search_runs(ids, "attributes.status = 'RUNNING'", max_results=1000)
    past = tracking.trainings(NAME, TARGET, configured)
    trainings = {}
    for training_id in past["training_id"]:
        cells = tracking.load_training(str(training_id), configured).result.cells
        rows = cells[["protocol", "family", "n_tsp", "S_mean_um"]].to_dict("split")["data"]
        trainings[str(training_id)] = sorted(rows)
    out: dict[str, Any] = {"running": [r.info.run_id for r in running], "trainings": trainings, "versions": {},
                           "newest": str(past.iloc[0]["training_id"]) if len(past) else ""}  # fmt: skip
    models = {m.name: m for m in client.search_registered_models()}
    if MODEL not in models:
        return out | {"champion": None, "logged": None}
    log = audit.read(models[MODEL])
    out["versions"] = {v.version: v.tags.get("outcome", "") for v in model_versions(client, MODEL)}
    out |= {"champion": log.champion, "logged": log.reigns[-1].version if log.reigns else None}
    out["noted"] = [r.note for r in log.reigns if r.note]
    shown = registry.status(configured)
    crowned = shown[(shown["name"] == MODEL) & shown["aliases"].str.contains("champion")]
    out["shown"] = int(crowned.iloc[0]["version"]) if len(crowned) else None
    if log.champion is not None:
        source = registry.find_version(client, MODEL, str(log.champion)).source
        model = model_store.load(Path(registry.local_folder(source, configured)))
        from data.recording import read_batches

        (batch,) = read_batches(home.parent / "in" / "20250714.csv", model.machine)
        out["predicted"] = [float(v) for v in model.predict(batch)[::6]]
        out["cell"] = str(model.info["cell"])
    return out


def facts_of(work: Work) -> dict[str, Any]:
    code, text = work.run(["--facts", work.home], "tests.chaos")
    if code != 0 or "FACTS " not in text:
        return {"unreadable": text[-2000:]}
    known: dict[str, Any] = json.loads(text.rpartition("FACTS ")[2])
    return known


def broken_now(f: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Invariants that hold at any time, and what is wrong."""
    if "unreadable" in f:
        yield "unreadable", f["unreadable"][-600:]
        return
    for text in f["lake_trouble"]:
        yield "lake", text
    if f.get("running"):
        yield "running", f"runs left RUNNING: {f['running']}"
    champion = f.get("champion")
    if len({champion, f.get("logged"), f.get("shown", champion)}) > 1 or f.get("noted"):
        yield "registry", f"alias {champion}, log {f.get('logged')}, status {f.get('shown')}, {f.get('noted')}"
    if champion is not None and f["versions"].get(str(champion)) != "champion":
        yield "half-promoted", f"champion {champion} has outcome {f['versions'].get(str(champion))!r}"


def differs(f: dict[str, Any], reference: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Where the home after the repeated command is not that of an undisturbed run."""
    for key in ("lake", "quarantine", "cell", "state"):
        if f.get(key) != reference.get(key):
            yield "numbers", f"{key}: {f.get(key)} instead of {reference.get(key)}"
    pairs = {"predicted": (f.get("predicted"), reference.get("predicted"))}
    if reference.get("newest"):
        a, b = (x["trainings"].get(x["newest"], []) for x in (f, reference))
        pairs["scores"] = ([row[3] for row in a], [row[3] for row in b])
    if "corrections" in reference:
        a, b = f.get("corrections", {}), reference["corrections"]
        pairs["last sample"] = ([a.get("time_s", 0.0)], [b["time_s"]])
        if abs(a.get("offset_um", np.inf) - b["offset_um"]) > 0.05:  # a restart goes on from what was sent
            yield "numbers", f"correction {a} instead of {b}"
    for key, (a, b) in pairs.items():
        if (a is None) != (b is None) or (a is not None and b is not None and not _same(a, b)):
            yield "numbers", f"{key}: {a} instead of {b}"


def _same(a: Sequence[float], b: Sequence[float]) -> bool:
    return len(a) == len(b) and bool(np.allclose(a, b, rtol=SAME, atol=SAME, equal_nan=True))


class Chaos:
    """Kills of one command."""

    def __init__(self, work: Work, key: str, seed: int) -> None:
        self.work, self.key, self.seed, self.case = work, key, seed, CASES[key]

    def reference(self, template: str) -> tuple[float, dict[str, Any]]:
        """Seconds and facts of an undisturbed run, measured once."""
        if (self.key, template) not in self.work.references:
            self.work.renew(template)
            begun_s = time.monotonic()
            self.work.must(self.case.arguments(self.work), self.case.module)
            seconds = time.monotonic() - begun_s
            known = facts_of(self.work)
            if wrong := list(broken_now(known)):
                raise RuntimeError(f"an undisturbed {self.key} breaks invariants: {wrong}")
            self.work.references[self.key, template] = seconds, known
        return self.work.references[self.key, template]

    def kill(self, number: int) -> Kill:
        """One kill, and all that is seen after it."""
        template = self.case.templates[number % len(self.case.templates)]
        usual_s, reference = self.reference(template)
        rng = random.Random(f"{self.seed} {self.key} {number}")
        command, moment_s, left = self._killed(template, usual_s, rng, everything=number // 2 % 2 == 1)
        lines = [line for line in command.output().splitlines() if line.strip()]
        wrong = [("survivors", text) for text in left]
        before = finished_trainings(self.work.home)
        kept = len(list(self.work.home.glob("unfinished/*/z__*")))
        try:
            wrong += [("lake", text) for text in lake_trouble(self.work.home)]
        except Exception as error:
            wrong.append(("lake", f"{type(error).__name__}: {error}"))
        code, said = self.work.run(["status", "--json"])
        if code != 0:
            wrong.append(("status", said[-600:]))
        wrong += [("after status", f"{k}: {t}") for k, t in broken_now(facts_of(self.work)) if k != "running"]
        code, said = self.work.run(self.case.arguments(self.work), self.case.module)
        if code != 0 or "not retrained" in said:
            wrong.append(("again", f"exit code {code}: {said[-600:]}"))
        known = facts_of(self.work)
        wrong += [*broken_now(known), *(differs(known, reference) if "unreadable" not in known else ())]
        if lost := set(before) - set(known.get("trainings", {})):
            wrong.append(("trainings", f"vanished: {sorted(lost)}"))
        resumed = f"resumes: {len(FAMILIES)} finished parts" in said or "nothing new to learn" in said
        if kept == len(FAMILIES) and not resumed and self.key != "schedule":  # a scheduled run prints its summary alone
            wrong.append(("grid again", said[-400:]))
        phase = lines[-1][:80] if lines else "start"
        return Kill(self.key, template, moment_s, moment_s / usual_s, phase, tuple(wrong))

    def _killed(
        self, template: str, usual_s: float, rng: random.Random, everything: bool
    ) -> tuple[Command, float, list[str]]:
        """The killed command, when, and what survived; a command that ends before its moment is started anew."""
        longest_s = usual_s
        while True:
            self.work.renew(template)
            moment_s = rng.uniform(0.02, 0.98) * longest_s
            begun_s = time.monotonic()
            command = Command(self.work.home, *self.case.arguments(self.work), module=self.case.module)
            try:
                command.process.wait(moment_s)
                longest_s = time.monotonic() - begun_s  # the computer is less busy than it was for the reference
                continue
            except subprocess.TimeoutExpired:
                os.killpg(command.process.pid, signal.SIGKILL)
            if everything:
                command.kill()
            command.process.wait()
            end_s = time.monotonic() + ORPHANS_S
            while (left := command.processes()) and time.monotonic() < end_s:
                time.sleep(0.05)
            command.kill()
            return command, moment_s, list(left.values())


def summary(kills: Sequence[Kill]) -> list[dict[str, Any]]:
    """A row per command: kills, kills after which anything was broken, and what, and the median moment."""
    rows = []
    for key in dict.fromkeys(k.command for k in kills):
        own = [k for k in kills if k.command == key]
        names = [name for k in own for name in dict.fromkeys(name for name, _ in k.wrong)]
        rows.append({
            "command": key, "kills": len(own), "kills_with_a_broken_invariant": sum(bool(k.wrong) for k in own),
            "broken": {name: names.count(name) for name in dict.fromkeys(names)},
            "median_moment_s": round(statistics.median(k.moment_s for k in own), 2),
            "median_share": round(statistics.median(k.share for k in own), 3),
        })  # fmt: skip
    return rows


def run(out: Path, kills: int, seed: int, only: Sequence[str], say: Callable[[str], None] = print) -> list[Kill]:
    """`kills` kills, spread over the commands in turn."""
    work, found = Work(out), []
    for n in range(kills):
        key, number = only[n % len(only)], n // len(only)
        found.append(kill := Chaos(work, key, seed).kill(number))
        if kill.wrong:
            shutil.copytree(work.home, out / f"broken-{key}-{number}", dirs_exist_ok=True)
        say(f"{key} {number} ({kill.template}) at {kill.moment_s:.2f} s, {kill.phase!r}: "
            f"{'; '.join(map(': '.join, kill.wrong))[:500] or 'whole'}")  # fmt: skip
    return found


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.chaos", description=__doc__)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default=",".join(CASES))
    parser.add_argument("--out", type=Path, default=ROOT / "var" / "chaos", help="work folder")
    parser.add_argument("--table", type=Path, help="where a row for each command goes, such as results/kills.csv")
    parser.add_argument("--facts", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.facts:
        print("FACTS " + json.dumps(facts(given.facts)))
        return
    only = list(dict.fromkeys(k for k in given.only.split(",") if k))
    if unknown := set(only) - set(CASES):
        parser.error(f"--only: unknown {', '.join(sorted(unknown))}; expected {', '.join(CASES)}")
    rows = summary(run(given.out, given.kills, given.seed, only))
    for row in rows:
        print(f"{row['command']:<11} kills {row['kills']:>4}, broken after {row['kills_with_a_broken_invariant']:>3} "
              f"{row['broken'] or ''}, median moment {row['median_moment_s']:.1f} s "
              f"({100 * row['median_share']:.0f} % of an undisturbed run)")  # fmt: skip
    if given.table:
        import pandas as pd

        from benchmarks.results import write

        write(given.table, pd.DataFrame(rows).drop(columns="broken"), f"python -m tests.chaos --table {given.table}")


if __name__ == "__main__":
    main()
