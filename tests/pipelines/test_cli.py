"""The command line as a user meets it: exit codes, one line of trouble, clean JSON, any working directory."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Iterator
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from pipelines import cli
from pipelines.commands.ingest import print_findings
from pipelines.fleet import watching
from tests.toys.command import Call
from tests.toys.small_year import law_um, write_machine, write_year

ROOT = Path(cli.__file__).resolve().parents[1]
NAME = "small-cli"


@pytest.fixture(scope="module")
def year(store: Any, store_home: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder with a machine file and recordings, promoted once without and once with a model."""
    folder = tmp_path_factory.mktemp("cli-year")
    machine = write_machine(folder / "small.yml", NAME)
    write_year(folder / "in")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("THERMODRIFT_HOME", str(store_home))
        patch.setenv("COLUMNS", "200")
        common = ["--machine", str(machine), "--channels", "z", "--direct", "--selectors", "none",
                  "--protocols", "leave-batch-out"]  # fmt: skip
        for families, more in (("zero", ["--recordings", str(folder / "in")]), ("zero,ridge", [])):
            patch.setattr(sys, "argv", ["thermodrift", "train", *common, "--families", families, *more])
            with pytest.raises(SystemExit) as ended:
                cli.main()
            assert not ended.value.code
        yield folder


def lines(text: str) -> list[str]:
    return text.strip().splitlines()


def test_training_shows_what_came_of_it(year: Path, call: Call) -> None:
    done = call("train", "--machine", year / "small.yml", "--channels", "z", "--direct", "--families", "zero, ridge",
                "--selectors", "none", "--protocols", "leave-batch-out", "--report", year / "r.md")  # fmt: skip
    assert done.code == 0
    assert lines(done.out)[0].startswith("z: expected error by leave-batch-out: S ")
    assert "; no model " in lines(done.out)[0] and "nothing new registered" in lines(done.out)[0]
    assert all(f"{what} {year / name}" in done.out for what, name in (("report  ", "r.md"), ("details ", "r.txt")))
    assert len(lines(done.out)) + len(lines(done.err)) < 24, "one screen"
    details = (year / "r.txt").read_text(encoding="utf-8")
    assert f"{NAME} z  (simulated recordings), S mean ± std, µm" in details and "nothing new registered" in details
    assert all(word in details for word in ("ridge", "zero", "batch out"))
    assert (year / "r.md").exists()
    assert watching.warm() is not None, "`status` after it needs no MLflow"
    assert lines(done.err)[0] == "features and selectors of 6 batches"


def test_training_as_json_is_alone_on_standard_output(year: Path, call: Call) -> None:
    done = call("train", "--machine", year / "small.yml", "--channels", "z", "--direct", "--families", "zero,ridge",
                "--selectors", "none", "--protocols", "leave-batch-out", "--json")  # fmt: skip
    got = json.loads(done.out, parse_constant=lambda word: pytest.fail(f"{word} is no JSON"))
    assert (done.code, done.err) == (0, "")
    assert got["machine"] == NAME and got["simulated"] is True and got["stopped"] == ""
    assert got["best"]["z"][0]["family"] == "ridge" and Path(got["report"]).exists()
    assert set(got["trainings"]) == {"z"}
    assert got["expected"]["z"]["summary"].startswith("expected error by leave-batch-out: S ")


def test_ingest_says_what_it_did(year: Path, call: Call) -> None:
    done = call("ingest", year / "in", "--machine", year / "small.yml")
    assert done.code == 0
    assert "batches unchanged: 6" in done.out and "files in quarantine: 0" in done.out
    done = call("ingest", year / "in", "--machine", year / "small.yml", "--json")
    assert (done.code, done.err) == (0, "")
    assert [r["status"] for r in json.loads(done.out)] == ["unchanged"] * 6


def test_status_names_what_runs_where(year: Path, call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "60")
    done = call("status")
    assert done.code == 0
    assert f"  {NAME}: 6 batches, files in quarantine: 0" in done.out
    model = next(line for line in lines(done.out) if line.startswith(f"  {NAME}-z/2 champion: expected error by leave"))
    assert "none|ridge|3 over 6 batches, simulated; first champion of this machine and channel" in model
    done = call("status", "--json")
    got = json.loads(done.out)
    assert (done.code, done.err) == (0, "")
    assert got["lake"][NAME] == {"batches": 6, "quarantined": 0}
    mine = [m for m in got["models"] if m["name"] == f"{NAME}-z"]
    assert [(m["version"], m["aliases"]) for m in mine] == [(2, "champion")]  # `registry` has the others
    assert mine[0]["expected_by"] == "leave-batch-out" and mine[0]["expected_S_um"] < mine[0]["expected_S_bound90_um"]
    training = next(t for t in got["trainings"] if t["machine"] == NAME)
    assert training["training_id"] and training["target"] == "z"


def test_a_report_of_what_is_tracked(year: Path, call: Call, store_home: Path) -> None:
    done = call("report", "--machine", NAME, "--format", "md")
    path = store_home / "reports" / f"{NAME}.md"
    assert (done.code, done.out.strip()) == (0, str(path))
    assert "ridge" in path.read_text(encoding="utf-8")
    done = call("report", "--machine", NAME, "--out", year / "two.html")
    assert done.code == 0 and (year / "two.html").read_text(encoding="utf-8").lstrip().lower().startswith("<!doctype")
    done = call("report", "--machine", NAME, "--format", "md", "--out", year / "two.html")
    assert (done.code, lines(done.err)) == (2, [f"thermodrift: --out {year / 'two.html'}: unsupported file extension "
                                                "'.html'; give .md"])  # fmt: skip


def test_predict_from_another_folder(year: Path, call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    table = pd.read_csv(year / "in" / "20250314.csv")
    table.drop(columns=["x", "z"]).to_csv("run.csv", index=False)
    done = call("predict", "--model", f"models:/{NAME}-z@champion", "run.csv")
    assert done.code == 0 and [line.partition(" S ")[0] for line in lines(done.err)] == [
        "SIMULATED model or recordings", "1 run: expect", "rows: 73 read, 0 dropped; nothing masked",
    ]  # fmt: skip
    got = pd.read_csv(StringIO(done.out))
    assert np.abs(got["predicted_um"] - law_um(table)).max() < 1.5
    for ending in (".csv", ".parquet"):
        assert call("predict", "--model", f"models:/{NAME}-z@champion", "run.csv", "--out", f"p{ending}").code == 0
    assert np.allclose(pd.read_parquet("p.parquet")["predicted_um"], pd.read_csv("p.csv")["predicted_um"])


def test_promote_and_rollback(year: Path, call: Call) -> None:
    trainings = json.loads(call("status", "--json").out)["trainings"]
    mine = [t for t in trainings if t["machine"] == NAME]
    ridge = next(t for t in mine if t["best"].startswith("ridge"))["training_id"]
    done = call("promote", ridge, "--machine", year / "small.yml", "--cell", "none|zero|0", "--force")
    assert done.code == 0 and "version 1 is champion by force" in done.out
    back = call("rollback", f"{NAME}-z")
    assert (back.code, lines(back.out)) == (0, [f"{NAME}-z: champion is version 2 again; version 1 was rolled back"])


def test_describe_drafts_a_file_that_ingests(
    year: Path, call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = sorted((year / "in").glob("*.csv"))
    done = call("describe", *files)
    assert done.code == 0 and "# guessed" in done.out and "front:" in done.out
    assert done.out.index("\n  z:") < done.out.index("\n  x:"), "the largest error first"
    assert "a champion needs at least 9 runs, there are 6" in done.err
    draft = tmp_path / "draft.yml"
    done = call("describe", *files, "--out", draft)
    assert done.code == 0 and "a draft; check every line marked 'guessed'" in done.out
    assert "\nmachine: draft  # the name of this file\n" in draft.read_text()
    again = call("describe", *files, "--out", draft)
    assert (again.code, lines(again.err)) == (
        2,
        [f"thermodrift: {draft} exists; give another --out or remove it first"],
    )
    monkeypatch.setenv("THERMODRIFT_HOME", str(tmp_path / "home"))
    done = call("ingest", year / "in", "--machine", draft)
    assert done.code == 0 and "batches new: 6" in done.out


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["trian"], "No such command 'trian'"),
        (["train", "--macine", "x"], "No such option: --macine"),
        (["train"], "Missing option '--machine'; see `thermodrift train --help`"),
        (["ingest", "--machine", "x.yml"], "Missing argument 'paths'"),
        (["train", "--machine", "{yml}", "--families", "ridgge"], "unknown family 'ridgge': did you mean 'ridge'?"),
        (["train", "--machine", "{yml}", "--selectors", "fcg"], "unknown selector 'fcg': did you mean 'fcgc'?"),
        (["train", "--machine", "{yml}", "--protocols", "lbo"], "unknown protocol 'lbo'"),
        (["train", "--machine", "{yml}", "--channels", "zz"], "nobody: no error channel 'zz'; did you mean 'z'"),
        (["train", "--machine", "{yml}", "--recordings", "gone"], "recordings gone: no such file or folder"),
        (["train", "--machine", "{yml}", "--report", "r.pdf"],
         "report r.pdf: unsupported file extension '.pdf'; give .html"),
        (["train", "--machine", "{yml}", "--protocols", "train-on-one"], "promotion judges by forward, leave-season"),
        (["report", "--machine", "m", "--format", "pdf"], "--format: got 'pdf', expected html or md"),
        (["predict", "f.csv", "--model", "m", "--out", "p.xlsx"],
         "--out p.xlsx: unsupported file extension '.xlsx'; give .csv or .parquet"),
        (["predict", "f.csv", "--model", "no-such-folder"], "model 'no-such-folder': no such folder; expected"),
        (["simulate"], "got nothing to simulate; call `thermodrift simulate --sample-year"),
        (["simulate", "--sample-year", "--seed", "-1", "--out", "y"], "seed: got -1, expected 0 or more"),
        (["schedule", "--machine", "{yml}", "--recordings", "gone"], "--recordings gone: no such file or folder"),
        (["describe", "gone.csv"], "gone.csv"),
    ],
)  # fmt: skip
def test_bad_arguments_are_one_line_and_exit_code_2(
    args: list[str], words: str, call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("THERMODRIFT_HOME", str(tmp_path / "home"))
    machine = write_machine(tmp_path / "nobody.yml", "nobody")
    done = call(*(a.format(yml=machine) for a in args))
    assert (done.code, done.out) == (2, "")
    (line,) = lines(done.err)
    assert line.startswith("thermodrift: ") and words in line
    assert not (tmp_path / "home" / "mlflow.db").exists()  # judged before anything was started


def test_work_that_fails_is_one_line_and_exit_code_1(
    year: Path, call: Call, store_home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(store_home / "lake", tmp_path / "lake")
    for manifest in (tmp_path / "lake" / "_manifest").iterdir():
        manifest.write_text("{ broken")
    monkeypatch.setenv("THERMODRIFT_HOME", str(tmp_path))
    done = call("ingest", year / "in", "--machine", year / "small.yml", "--json")
    assert (done.code, done.out) == (1, "")
    (line,) = lines(done.err)
    assert ".json: cannot be read" in line and "restore it from a backup" in line


def test_nothing_there_yet_is_no_error(call: Call, store: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copy(store.store_file, tmp_path / "mlflow.db")  # a migrated store; the lake is empty
    monkeypatch.setenv("THERMODRIFT_HOME", str(tmp_path))
    done = call("status")
    assert done.code == 0 and "empty; `thermodrift ingest` fills it" in done.out


def test_simulate_writes_the_labelled_year(call: Call, tmp_path: Path) -> None:
    done = call("simulate", "--sample-year", "--out", tmp_path / "y")
    assert done.code == 0 and "30 simulated recordings of the sample machine, seed 0" in done.out
    assert len(list((tmp_path / "y").glob("*.csv"))) == 30
    own = tmp_path / "y" / "sample_vmc.yml"
    assert own.read_bytes() == (ROOT / "machines" / "sample_vmc.yml").read_bytes()
    own.write_text("edited", encoding="utf-8")
    assert "kept as it is" in call("simulate", "--sample-year", "--out", tmp_path / "y").out
    assert own.read_text(encoding="utf-8") == "edited"


def test_what_the_checks_found_is_a_line_per_check_and_channel(capsys: pytest.CaptureFixture[str]) -> None:
    found = [("b1", "offset", "t3", True, ""), ("b2", "offset", "t3", True, ""), ("b2", "unexplained", "z", False, ""),
             ("b3", "spike", "t1", True, "checked by hand"), ("b3", "gap", None, False, "")]  # fmt: skip
    found += [(f"c{i}", "error_held", "z", True, "") for i in range(6)]
    print_findings(pd.DataFrame(found, columns=["batch_id", "check", "channel", "masks", "overruled"]))
    assert capsys.readouterr().out.splitlines() == [
        "  offset: t3 in 2 batches (b1, b2), masked",
        "  unexplained: z in 1 batch (b2), noted, not masked",
        "  spike: t1 in 1 batch (b3), noted, not masked",
        "  gap: all channels in 1 batch (b3), noted, not masked",
        "  error held: z in 6 batches (c0, c1, c2, …, c5), masked",
    ]
