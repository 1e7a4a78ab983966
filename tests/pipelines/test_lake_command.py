"""`thermodrift lake`, and what training makes of a lake with withdrawn batches, copies or other channels."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from data.errors import InputError
from data.lake import Lake
from data.machine import load_machine
from pipelines.caller import DirectCaller
from pipelines.jobs.recordings import gather_batches, load_batches
from pipelines.jobs.request import TrainRequest
from pipelines.jobs.training import Plan, promote_tracked, train
from tests.conftest import make_toy_batches
from tests.toys.command import Call, in_process
from tests.toys.small_year import write_machine, write_year

NAME = "small-lake"
PLAN = Plan(selectors=("none",), families=("zero", "ridge"), protocols=("leave-batch-out",))


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], year: Path, store_home: Path) -> Call:
    """`thermodrift ARGS` in this process, on the lake of the trained year as it was after the training."""
    monkeypatch.setenv("THERMODRIFT_HOME", str(store_home))
    monkeypatch.setenv("COLUMNS", "200")
    shutil.rmtree(store_home / "lake")
    shutil.copytree(year / "kept", store_home / "lake")
    return in_process(monkeypatch, capsys)


@pytest.fixture(scope="module")
def year(store: Any, store_home: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder with a machine file and six recordings that were trained on, and a copy of the lake."""
    folder = tmp_path_factory.mktemp("lake-year")
    machine = write_machine(folder / "small.yml", NAME)
    write_year(folder / "in")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("THERMODRIFT_HOME", str(store_home))
        outcome = train(TrainRequest(machine, (folder / "in",), ("z",), PLAN), store, DirectCaller())
        (folder / "training").write_text(outcome.training_ids["z"])
        shutil.copytree(store_home / "lake", folder / "kept")
        yield folder


def test_list_and_show(year: Path, call: Call) -> None:
    (row,) = [r for r in json.loads(call("lake", "list", "--json").out) if r["machine"] == NAME]
    assert (row["batches"], row["withdrawn"], row["versions"], row["quarantined"]) == (6, 0, 6, 0)
    done = call("lake", "list", NAME)
    assert done.code == 0 and done.out.count("in use") == 6 and "20250114.csv" in done.out
    shown = json.loads(call("lake", "show", NAME, "20250114", "--json").out)
    assert shown["start"].startswith("2025-01-14") and [v["state"] for v in shown["versions"]] == ["in use"]
    (used,) = shown["trainings"]
    assert used["training_id"] == (year / "training").read_text() and used["target"] == "z"
    assert used["digest"] == shown["versions"][0]["digest"] and used["models"] == [f"{NAME}-z/1 champion"]
    assert f"models {NAME}-z/1 champion" in call("lake", "show", NAME, "20250114").out


def test_withdraw_and_restore(year: Path, call: Call, store: Any) -> None:
    done = call("lake", "withdraw", NAME, "202501*", "--reason", "door open")
    assert done.out.splitlines() == [
        f"{NAME} 20250114: withdrawn",
        f"models that were trained with these batches: {NAME}-z/1 champion; train again to replace them",
    ]
    done = call("ingest", year / "in", "--machine", year / "small.yml")
    assert "batches withdrawn: 1, batches unchanged: 5" in done.out
    assert f"20250114.csv (20250114): withdrawn: door open; restore with `thermodrift lake restore {NAME}" in done.out
    request = TrainRequest(year / "small.yml", (year / "in",), ("z",), PLAN, promote=False)
    assert len(train(request, store, DirectCaller()).results["z"].batches) == 5
    with pytest.raises(InputError, match=r"20250114 of small-lake is withdrawn \(door open\)"):
        promote_tracked((year / "training").read_text(), year / "small.yml", "none|ridge|3", False, store)
    assert "door open" in call("lake", "list", NAME).out
    done = call("lake", "restore", NAME, "*", "--json")
    assert json.loads(done.out) == {"machine": NAME, "restored": ["20250114"], "ingest_again": []}


def test_forget_and_purge(call: Call, year: Path, store_home: Path) -> None:
    assert call("lake", "forget-machine", NAME, "--reason", "sold").code == 0
    assert f"{NAME}: " not in call("status").out.partition("Registered models")[0]
    done = call("lake", "purge", NAME, "20250114")
    assert done.code == 2 and f"withdrawn batches of {NAME}: 1, 0.0 MB); give --yes" in done.err
    done = call("lake", "purge", NAME, "20250114", "--yes", "--json")
    assert json.loads(done.out)["purged"] == ["20250114"]
    assert not list((store_home / "lake" / "_versions" / f"machine={NAME}").glob("20250114/*"))
    assert call("lake", "show", NAME, "20250114").out.startswith(f"{NAME} 20250114: purged")
    done = call("lake", "restore", NAME, "*")
    assert done.out.splitlines()[:2] == [
        f"{NAME} 20250114: its content was purged; ingest its recording again",
        f"{NAME} 20250214: restored",
    ]
    assert "batches new: 1, batches unchanged: 5" in call("ingest", year / "in", "--machine", year / "small.yml").out
    done = call("lake", "purge", NAME, "--yes")
    assert done.code == 2 and "no withdrawn batch of small-lake has content" in done.err


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (("withdraw", NAME, "20250114"), "Missing option '--reason'"),
        (("withdraw", NAME, "2025014", "--reason", "x"), "no batch in use that fits '2025014'; did you mean '20250"),
        (("show", "small-lak", "20250114"), "no batch of machine 'small-lak'; did you mean 'small-lake'"),
        (("show", NAME, "nothing"), f"{NAME} has no batch 'nothing'"),
        (("restore", NAME, "*"), "no withdrawn batch that fits '*'"),
    ],
)
def test_what_cannot_be_done_is_one_line(args: tuple[str, ...], words: str, call: Call) -> None:
    done = call("lake", *args)
    assert (done.code, done.out, len(done.err.splitlines())) == (2, "", 1) and words in done.err


def test_copies_given_to_a_command_are_the_stored_batches(year: Path, call: Call, tmp_path: Path) -> None:
    copy = shutil.copy(year / "in" / "20250214.csv", tmp_path / "20260101.csv")
    gathered = gather_batches(load_machine(year / "small.yml"), [Path(copy)], (), lambda text: None)
    assert [b.batch_id for b in gathered.batches] == ["20250214"]


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("  bed:", "  base:", "not stored: base; no longer in the machine file: bed;"),
        ("  bed: {role: temperature", "  bed: {role: ambient", "changed: bed (temperature in degC → ambient in degC);"),
        ("  x: ", "  tip: {role: temperature, unit: degC}\n  x: ", "channels; not stored: tip; ingest their"),
    ],
)
def test_stored_batches_with_other_channels_are_one_line(
    old: str, new: str, words: str, year: Path, call: Call, store_home: Path, tmp_path: Path
) -> None:
    changed = tmp_path / "changed.yml"
    changed.write_text((year / "small.yml").read_text().replace(old, new))
    lake = Lake(store_home / "lake")
    with pytest.raises(InputError) as caught:
        load_batches(lake, load_machine(changed))
    told = str(caught.value)
    assert words in told and "6 of 6 batches in the lake (20250114, 20250214, 20250314, …)" in told
    assert call("ingest", lake.root / f"machine={NAME}", "--machine", changed).code == 0
    assert len(load_batches(lake, load_machine(changed))) == 6


def another_machine(folder: Path) -> tuple[Path, Path]:
    """A machine file with the same name, and recordings with the same names of files and the same speeds."""
    machine = write_machine(folder / "other.yml", NAME)
    machine.write_text(machine.read_text().replace("  bed: ", "  column: "))
    for file in write_year(folder / "in"):
        table = pd.read_csv(file).rename(columns={"bed": "column"})
        table.add([0, 1.5, 1.5, 1.5, 0, 3.0, 3.0]).to_csv(file, index=False)
    return machine, folder / "in"


@pytest.mark.parametrize("command", ["ingest", "train"])
@pytest.mark.parametrize("month", ["", "07"])
def test_another_machine_of_the_same_name_is_refused_before_anything_is_stored(
    command: str, month: str, year: Path, call: Call, store_home: Path, tmp_path: Path
) -> None:
    machine, recordings = another_machine(tmp_path)
    if month:
        recordings = recordings.joinpath("20250114.csv").rename(tmp_path / f"2025{month}14.csv")
    before = {p: p.read_bytes() for p in (store_home / "lake").rglob("*") if p.is_file()}
    given = ("ingest", recordings) if command == "ingest" else ("train", "--recordings", recordings, "--direct")
    done = call(*given, "--machine", machine)
    assert (done.code, done.out) == (2, "") and "Traceback" not in done.err
    assert (
        f"machine file {NAME}: the lake holds 6 batches under this name, of which 6 have other channels (not stored: "
        "column; no longer in the machine file: bed); nothing was stored. If they are of another machine, give this "
        "one a name of its own (key machine);" in done.err
    )
    assert {p: p.read_bytes() for p in (store_home / "lake").rglob("*") if p.is_file()} == before
    assert "batches unchanged: 6" in call("ingest", year / "in", "--machine", year / "small.yml").out


def test_recordings_do_not_join_simulated_batches(year: Path, call: Call, tmp_path: Path) -> None:
    machine = write_machine(tmp_path / "real.yml", NAME)
    machine.write_text(machine.read_text().replace("simulated: true\n", ""))
    (new,) = write_year(tmp_path / "in", 1, 7)
    done = call("ingest", new, "--machine", machine)
    assert done.code == 2 and "of which 6 are simulated, and the machine file's are recorded; nothing was" in done.err
    assert "batches new version: 6" in call("ingest", year / "in", "--machine", machine).out
    assert "batches new: 1" in call("ingest", new, "--machine", machine).out


def test_recordings_come_again_with_new_ones_after_a_change_of_the_machine_file(
    year: Path, call: Call, tmp_path: Path
) -> None:
    machine, _ = another_machine(tmp_path)
    machine.write_text(machine.read_text().replace("{role: temperature", "{column: bed, role: temperature", 2).replace(
        "front: {column: bed", "front: {column: front"))  # fmt: skip
    (new,) = write_year(tmp_path / "later", 1, 7)
    assert call("ingest", new, "--machine", machine).code == 2
    assert "batches new version: 1" in call("ingest", year / "in" / "20250114.csv", "--machine", machine).out
    assert "batches new version: 5, batches new: 1" in call("ingest", year / "in", new, "--machine", machine).out


def test_a_lake_of_an_earlier_version_is_migrated_and_signed(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("THERMODRIFT_HOME", str(tmp_path / "home"))
    monkeypatch.setenv("THE_KEY", "a key")
    Lake(tmp_path / "home" / "lake").put_many(make_toy_batches(2, 20))
    for file in (tmp_path / "home" / "lake").glob("_manifest*/*.json"):
        file.write_text(file.read_text().replace("lake/3", "lake/2"))
    assert call("lake", "list").err.endswith(
        "of an earlier version (thermodrift.lake/2); run `thermodrift lake migrate`\n"
    )
    (tmp_path / "mlflow.yml").write_text('lake_key: "{env:THE_KEY}"\n')
    done = call("lake", "migrate")
    assert (done.code, done.err) == (0, "") and done.out.endswith("manifests written, signed: 1; files read: 0\n")
    assert json.loads(call("lake", "list", "--json").out)[0]["batches"] == 2
    monkeypatch.setenv("THE_KEY", "another key")
    assert "set the key that it was signed with" in call("lake", "list").err
