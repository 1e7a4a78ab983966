"""Engines: names and addresses; the grid on a real Dask cluster gives the numbers of plain calls, bit for bit."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pandas as pd
import pytest

from data.errors import InputError, WorkError, one_of
from models.selection.crossing import FamilyResult, Plan, prepare
from models.selection.grid import Workers
from models.selection.race import rounds
from pipelines.caller import LANES, DirectCaller
from pipelines.engine import train_by
from pipelines.jobs.request import TrainRequest
from pipelines.jobs.training import TrainOutcome, train
from tests.conftest import make_toy_batches
from tests.toys.command import in_process
from tests.toys.postgres import free_port
from tests.toys.small_year import write_machine, write_year

NOTHING: Any = None  # where the call ends before it is needed
dask_pools = pytest.importorskip("pipelines.dask_pools", exc_type=InputError)
PLAN = Plan(("none", "correlation"), ("zero", "ridge", "pls"), ("leave-batch-out", "train-on-one"))
LONGER = Plan(("none",), ("zero", "ridge", "pls", "random_forest", "huber"), ("leave-batch-out",))


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    with dask_pools.open_cluster(None, 2) as running:
        yield running


def test_an_unknown_engine_or_an_address_without_use_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    call = in_process(monkeypatch, capsys)
    machine = write_machine(tmp_path / "m.yml", "engine-toy")
    done = call("train", "--machine", machine, "--engine", "dusk")
    assert done.code == 2 and "--engine: unknown value 'dusk': did you mean 'dask'?" in done.err
    done = call("train", "--machine", machine, "--engine", "dask", "--direct")
    assert done.code == 2 and "--direct is --engine direct; got --engine dask" in done.err
    for key in ("direct", "prefect"):
        with pytest.raises(InputError, match=f"--address: engine {key} takes none"):
            train_by(key, NOTHING, NOTHING, address="tcp://127.0.0.1:8786")
    with pytest.raises(InputError, match="--address: got 'host:8786', expected that of a Dask scheduler"):
        train_by("dask", NOTHING, NOTHING, address="host:8786")


def test_a_missing_package_names_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    monkeypatch.delitem(sys.modules, "pipelines.dask_pools")
    with pytest.raises(InputError, match=r"engine dask: .*run pip install 'thermodrift\[dask\]'"):
        train_by("dask", NOTHING, NOTHING)


def test_a_scheduler_that_is_not_there_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dask_pools, "ANSWER_S", 0.5)
    with pytest.raises(WorkError, match=r"^Dask cluster tcp://127.0.0.1:\d+: does not answer \([^\n]*\)$"):
        dask_pools.open_cluster(f"tcp://127.0.0.1:{free_port()}", 1).__enter__()


@pytest.mark.integration
def test_the_cluster_listens_on_this_computer_alone(cluster: Any) -> None:
    import psutil

    processes = [psutil.Process(), *(psutil.Process(pid) for pid in cluster.client.run(os.getpid).values())]
    found = [c.laddr.ip for p in processes for c in p.net_connections("inet") if c.status == psutil.CONN_LISTEN]
    assert len(found) >= 3 and set(found) == {"127.0.0.1"}


@pytest.mark.integration
def test_the_grid_on_workers_gives_the_same_numbers(cluster: Any) -> None:
    batches = make_toy_batches(4, 30)
    crossings = {"z": prepare(batches, "z", PLAN)}
    jobs = next(rounds(crossings["z"]))
    with Workers(crossings, 1) as here, Workers(crossings, 1, cluster.pools) as workers:
        for job in jobs:
            assert_same(workers.cross(job), here.cross(job))


@pytest.mark.slow
def test_the_grid_goes_on_after_all_workers_ended(cluster: Any) -> None:
    """Then nobody holds the crossings any more."""
    crossings = {"z": prepare(make_toy_batches(4, 30), "z", PLAN)}
    jobs = next(rounds(crossings["z"]))
    with Workers(crossings, 1) as here, Workers(crossings, 1, cluster.pools) as workers:
        assert_same(workers.cross(jobs[0]), here.cross(jobs[0]))
        for pid in cluster.client.run(os.getpid).values():
            os.kill(pid, signal.SIGKILL)
        assert_same(workers.cross(jobs[1]), here.cross(jobs[1]))


def assert_same(got: FamilyResult, wanted: FamilyResult) -> None:
    """Bit for bit."""
    pd.testing.assert_frame_equal(got.scores, wanted.scores, check_exact=True)
    pd.testing.assert_frame_equal(got.cells, wanted.cells, check_exact=True)
    bits = [{k: v.tobytes() for k, v in result.predictions.items()} for result in (got, wanted)]
    assert bits[0] == bits[1]


@pytest.mark.integration
def test_a_worker_with_another_program_is_refused(cluster: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dask_pools, "_program", lambda: {"numpy": "0.1"})
    with pytest.raises(WorkError, match="a Dask worker has another version of numpy; install the same"):
        cluster.submit(len, "abc")()


@pytest.mark.integration
def test_what_the_work_raises_is_raised_here(cluster: Any) -> None:
    assert cluster.submit(len, "abc")() == 3
    with pytest.raises(InputError, match="--family: unknown value 'rigde': did you mean 'ridge'"):
        cluster.submit(one_of, "rigde", ("ridge", "pls"), "--family")()


@pytest.mark.slow
def test_a_training_on_three_workers_one_of_which_ends(
    store: Any, store_home: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("THERMODRIFT_HOME", str(store_home))
    ended: list[int] = []
    with dask_pools.open_cluster(None, 3) as three:

        def done(step: str, n: int, of: int) -> None:
            if step.startswith("grid") and n == 1:
                ended.append(next(iter(three.client.run(os.getpid).values())))
                os.kill(ended[0], signal.SIGKILL)

        far = train(request(tmp_path, "engine-dask"), store, DirectCaller(done), pools=three.pools)
    near = train_by("direct", request(tmp_path, "engine-direct"), store)
    assert len(ended) == 1
    assert_same_training(far, near, "engine-dask", "engine-direct")
    assert "distributed" not in "".join(capfd.readouterr())


@pytest.mark.slow
def test_the_engine_as_prefect_runs_it(
    flows: ModuleType, store: Any, store_home: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("THERMODRIFT_HOME", str(store_home))
    said: list[str] = []
    far = train_by("dask", request(tmp_path, "engine-flow"), store, said.append)
    near = train_by("direct", request(tmp_path, "engine-plain"), store)
    assert f"Dask cluster 127.0.0.1: {LANES} workers" in said
    assert_same_training(far, near, "engine-flow", "engine-plain")


def request(folder: Path, name: str) -> TrainRequest:
    """A training of a machine of this name."""
    if not (folder / "in").exists():
        write_year(folder / "in")
    return TrainRequest(write_machine(folder / f"{name}.yml", name), (folder / "in",), ("z",), LONGER)


def assert_same_training(far: TrainOutcome, near: TrainOutcome, name: str, other: str) -> None:
    """Bit for bit."""
    a, b = far.results["z"], near.results["z"]
    for table in ("scores", "cells", "subsets", "predictions", "distances", "readings"):
        pd.testing.assert_frame_equal(getattr(a, table), getattr(b, table), check_exact=True)
    assert far.promotions["z"].summary == near.promotions["z"].summary.replace(other, name)
