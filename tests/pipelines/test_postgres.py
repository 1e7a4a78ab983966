"""MLflow and Prefect on a real PostgreSQL server: directly, through an MLflow server, two first trainings at once."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from data.errors import InputError, WorkError
from pipelines import settings
from pipelines.store import database, tracking
from tests.toys.command import Call, in_process
from tests.toys.postgres import PASSWORD, Server, free_port, postgres
from tests.toys.small_year import write_machine, write_year
from tests.toys.tracked import log_training
from tests.toys.training import toy_batches, toy_result

ROOT = Path(__file__).parents[2]
TRAIN = ("--channels", "z", "--selectors", "none", "--families", "zero,ridge", "--protocols", "leave-batch-out",
         "--direct")  # fmt: skip
RULE = "promotion: {protocols: {leave-batch-out: 1.0}}\n"


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with postgres() as running:
        yield running


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Call:
    """The command in a folder and home of the test's own; the password comes from the environment."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("THERMODRIFT_HOME", str(tmp_path / "home"))
    monkeypatch.setenv("STORE_PASSWORD", PASSWORD)
    return in_process(monkeypatch, capsys)


def write_settings(folder: Path, address: str, artifacts: str = '"{home}/artifacts"') -> None:
    stored = address.replace(PASSWORD, "{env:STORE_PASSWORD}")
    (folder / "mlflow.yml").write_text(f'tracking: {{store: "{stored}", artifacts: {artifacts}}}\n{RULE}')


@pytest.mark.integration
def test_a_training_is_tracked_in_postgresql(server: Server, call: Call, tmp_path: Path) -> None:
    write_settings(tmp_path, server.create("tracked"))
    loaded, said = settings.load(), list[str]()
    assert loaded.store_uri == server.address("tracked") and PASSWORD not in repr(loaded)
    tracking.open_store(loaded, said.append)
    assert said == [
        f"first use: making the tables of the tracking store {loaded.store_name} (takes some seconds, once)"
    ]
    result = toy_result(toy_batches("pg-toy", 3), {"none|zero|0": [9.0, 8.0, 10.0], "none|mlr|2": [1.0, 2.0, 1.5]})
    training_id = log_training(result, loaded, say=said.append)
    assert len(said) == 1
    listed = tracking.trainings("pg-toy", settings=loaded)
    assert listed["training_id"].tolist() == [training_id] and listed["n_batches"].tolist() == [3]
    assert tracking.load_training(training_id, loaded).result.cells.equals(result.cells)


@pytest.mark.integration
def test_what_does_not_answer_is_one_line_without_the_password(server: Server, call: Call, tmp_path: Path) -> None:
    address = server.address("nowhere")
    for broken, words in (
        (address.replace("@127.0.0.1", "x@127.0.0.1"), "password authentication failed"),
        (address, 'database "nowhere" does not exist'),
        (address.replace(f":{server.port}", f":{free_port()}"), "Connection refused"),
    ):
        write_settings(tmp_path, broken)
        done = call("status")
        assert done.code == 1 and words in done.err and done.err.count("\n") == 1
        assert "://***@127.0.0.1" in done.err and PASSWORD not in done.out + done.err


@pytest.mark.integration
def test_one_process_at_a_time_holds_a_key(server: Server, call: Call, tmp_path: Path) -> None:
    write_settings(tmp_path, server.create("locks"))
    loaded = settings.load()
    held = "select count(*) from pg_locks where locktype = 'advisory' and granted"

    def enter() -> str:
        with database.exclusive(loaded, "a"):
            return server.sql("locks", held)

    with ThreadPoolExecutor(1) as pool:  # has a connection of its own, as another computer would
        with database.exclusive(loaded, "a"):
            with database.exclusive(loaded, "b"):
                assert server.sql("locks", held) == "2"
            entered = pool.submit(enter)
            while server.sql("locks", "select count(*) from pg_locks where not granted") != "1":
                assert not entered.done()
        assert entered.result(timeout=60) == "1"
    assert server.sql("locks", held) == "0"


def test_a_driver_that_is_missing_names_the_command(call: Call, tmp_path: Path) -> None:
    write_settings(tmp_path, "postgresql+psycopg2://u:secret@127.0.0.1/x")
    with pytest.raises(InputError, match=r"driver is not installed; .*pip install 'thermodrift\[service\]'") as caught:
        tracking.open_store(settings.load())
    assert "secret" not in str(caught.value)


def test_an_mlflow_server_that_is_not_there_is_told_at_once(call: Call, tmp_path: Path) -> None:
    loaded = replace(settings.load(), store_uri=f"http://someone:secret@127.0.0.1:{free_port()}")
    with pytest.raises(WorkError, match=r"http://\*\*\*@127.*does not answer .*Connection refused"):
        tracking.open_store(loaded)


@pytest.mark.integration
@pytest.mark.slow
def test_the_yearly_job_on_postgresql(server: Server, call: Call, tmp_path: Path) -> None:
    write_settings(tmp_path, server.create("job"))
    trained_and_used(call, tmp_path, "pg-job")
    assert server.sql("job", "select name from registered_models") == "pg-job-z"


@pytest.mark.integration
@pytest.mark.slow
def test_the_yearly_job_through_an_mlflow_server(server: Server, call: Call, tmp_path: Path) -> None:
    with mlflow_server(server.create("served"), tmp_path) as address:
        write_settings(tmp_path, address, artifacts="null")
        trained_and_used(call, tmp_path, "pg-served")
    assert server.sql("served", "select name from registered_models") == "pg-served-z"
    assert list((tmp_path / "artifacts").rglob("model.json"))


@pytest.mark.integration
@pytest.mark.slow
def test_two_first_trainings_at_once(server: Server, tmp_path: Path) -> None:
    """Two computers, each with its own home, the same machine and an empty database."""
    write_settings(tmp_path, server.create("twice"))
    machine = write_machine(tmp_path / "m.yml", "pg-twice")
    write_year(tmp_path / "in")
    command = [sys.executable, "-m", "pipelines.cli", "train", "--machine", str(machine), "--recordings", "in", *TRAIN,
               "--json"]  # fmt: skip
    homes = [tmp_path / "one", tmp_path / "two"]
    running = [
        subprocess.Popen(
            command, cwd=tmp_path, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            env={**os.environ, "THERMODRIFT_HOME": str(home), "STORE_PASSWORD": PASSWORD, "PYTHONPATH": str(ROOT)},
        )
        for home in homes
    ]  # fmt: skip
    ended = [p.communicate(timeout=300) for p in running]
    assert [p.returncode for p in running] == [0, 0], ended
    summaries = sorted(json.loads(out)["promotions"]["z"] for out, _ in ended)
    assert "version 1 is champion" in summaries[1] or "version 1 is champion" in summaries[0]
    assert any("nothing new registered" in s for s in summaries)
    assert server.sql("twice", "select count(*) from model_versions") == "1"


@pytest.mark.integration
@pytest.mark.slow
def test_prefects_server_on_postgresql_runs_a_training(server: Server, call: Call, tmp_path: Path) -> None:
    server.create("prefect")
    write_settings(tmp_path, server.create("flows"))
    machine = write_machine(tmp_path / "m.yml", "pg-flow")
    write_year(tmp_path / "in")
    with prefect_server(server.address("prefect", "asyncpg"), tmp_path) as address:
        environment = {
            **os.environ, "PREFECT_API_URL": address, "PYTHONPATH": str(ROOT),
            "THERMODRIFT_HOME": str(tmp_path / "home"),
        }  # fmt: skip
        command = [sys.executable, "-m", "pipelines.cli", "train", "--machine", str(machine), "--recordings", "in",
                   *TRAIN[:-1]]  # fmt: skip
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    assert "pg-flow-z version 1 is champion" in done.stdout
    assert server.sql("prefect", "select state_type from flow_run") == "COMPLETED"
    assert int(server.sql("prefect", "select count(*) from task_run where state_type = 'COMPLETED'")) >= 7


def trained_and_used(call: Call, folder: Path, name: str) -> None:
    """A training by the command, then champion, status, registry and predict of what it stored."""
    machine = write_machine(folder / "m.yml", name)
    files = write_year(folder / "in")
    trained = call("train", "--machine", machine, "--recordings", folder / "in", *TRAIN)
    assert trained.code == 0 and f"{name}-z version 1 is champion" in trained.out, trained.err
    assert f"{name}-z" in call("status").out
    log = call("registry", f"{name}-z", "--json")
    assert log.code == 0 and [line["action"] for line in json.loads(log.out)] == ["promote"], log.err
    out = folder / "predicted.csv"
    predicted = call("predict", files[0], "--model", f"models:/{name}-z@champion", "--out", out)
    assert predicted.code == 0 and out.exists(), predicted.err
    assert PASSWORD not in "".join((trained.out, trained.err, log.out, log.err, predicted.out, predicted.err))
    files_kept = [p for p in (folder / "home").rglob("*") if p.is_file()]
    assert files_kept and not any(PASSWORD.encode() in p.read_bytes() for p in files_kept)


@contextmanager
def mlflow_server(store_address: str, folder: Path) -> Iterator[str]:
    """`mlflow server` on a store; the address comes from the environment, where no list of processes shows it."""
    port = free_port()
    command = [sys.executable, "-m", "mlflow", "server", "--host", "127.0.0.1", "--port", str(port), "--workers", "1",
               "--artifacts-destination", str(folder / "artifacts")]  # fmt: skip
    environment = {
        **os.environ, "MLFLOW_BACKEND_STORE_URI": store_address, "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false",
    }  # fmt: skip
    with _serving(command, environment, f"http://127.0.0.1:{port}", "/health", folder):
        yield f"http://127.0.0.1:{port}"


@contextmanager
def prefect_server(database: str, folder: Path) -> Iterator[str]:
    """`prefect server start` on a database."""
    port = free_port()
    command = [sys.executable, "-m", "prefect", "server", "start", "--host", "127.0.0.1", "--port", str(port)]
    environment = {
        **os.environ, "PREFECT_API_DATABASE_CONNECTION_URL": database, "PREFECT_HOME": str(folder / "prefect"),
    }  # fmt: skip
    with _serving(command, environment, f"http://127.0.0.1:{port}", "/api/health", folder):
        yield f"http://127.0.0.1:{port}/api"


@contextmanager
def _serving(command: list[str], environment: dict[str, str], address: str, path: str, folder: Path) -> Iterator[None]:
    log = folder / "server.log"
    with log.open("w") as out:
        process = subprocess.Popen(
            command, stdout=out, stderr=subprocess.STDOUT, env=environment, cwd=folder, start_new_session=True
        )
    try:
        end_s = time.monotonic() + 180
        while not _answers(address + path):
            assert process.poll() is None and time.monotonic() < end_s, log.read_text()
            time.sleep(0.2)
        yield
    finally:
        os.killpg(process.pid, 9)
        process.wait()


def _answers(address: str) -> bool:
    try:
        urllib.request.urlopen(address, timeout=2).close()
    except OSError:
        return False
    return True
