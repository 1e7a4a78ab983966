from __future__ import annotations

import errno
import json
import os
import platform
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import mlflow
import pandas as pd
import pytest
from mlflow.tracking import MlflowClient

from data.errors import InputError, WorkError
from models.protocols import PromotionRule
from models.selection.promotion import judged
from pipelines.settings import NamesPart, Settings
from pipelines.store import audit, runs, tracking
from tests.toys.tracked import client_of, log_training
from tests.toys.training import toy_batches, toy_result

ROOT = Path(__file__).resolve().parents[2]

S_UM = {
    "none|zero|0": [9.0, 8.0, 10.0],
    "none|mlr|2": [1.0, 2.0, 1.5],
    "correlation|mlr|1": [5.0, 5.0, 5.0],
    "correlation|mlr|2": [1.0, 4.0, 1.5],
}


@pytest.fixture(scope="module")
def logged(store) -> tuple[Settings, str, object]:
    result = toy_result(toy_batches("toy-tracked", 3), S_UM)
    figures = {"heat.png": b"\x89PNG not really"}
    return store, log_training(result, store, figures=figures, params={"seed": 0}), result


def children(settings: Settings, training_id: str) -> dict[str, object]:
    client = client_of(settings)
    experiment = client.get_run(training_id).info.experiment_id
    found = client.search_runs([experiment], f"tags.mlflow.parentRunId = '{training_id}'")
    return {r.info.run_name: r for r in found}


def test_a_run_per_selector_and_family_with_points_and_folds_as_steps(logged):
    settings, training_id, _ = logged
    runs_of = children(settings, training_id)
    assert set(runs_of) == {"none × zero", "none × mlr", "correlation × mlr"}
    run = runs_of["correlation × mlr"]
    assert run.data.params["n_tsp"] == "2" and run.data.params["inputs"]
    assert run.info.status == "FINISHED"
    client = client_of(settings)
    history = client.get_metric_history(run.info.run_id, "leave_batch_out_by_n_tsp/S_mean_um")
    assert {m.step: m.value for m in history} == {1: 5.0, 2: pytest.approx(6.5 / 3, rel=1e-4)}
    folds = client.get_metric_history(run.info.run_id, "leave_batch_out_by_fold/S_um")
    assert {m.step: m.value for m in folds} == {0: 1.0, 1: 4.0, 2: 1.5}
    assert {f"leave_batch_out_by_n_tsp/{m}" for m in tracking.CURVES.values()} <= set(run.data.metrics)


def test_plain_columns_are_of_the_best_cell_in_the_parent_and_in_every_child(logged):
    """The list of runs shows a metric's last step; the plain ones have one step, and mean the same in every row."""
    settings, training_id, result = logged
    parent = client_of(settings).get_run(training_id)
    models = children(settings, training_id)
    worse, best = models["correlation × mlr"].data, models["none × mlr"].data
    cells = result.cells.set_index(["selector", "family", "n_tsp"])
    scores = judged(result, settings.promotion).set_index(["selector", "family", "n_tsp"])["score_um"]
    for run, cell in (
        (worse, ("correlation", "mlr", 2)),
        (best, ("none", "mlr", 2)),
        (parent.data, ("none", "mlr", 2)),
    ):
        row = cells.loc[cell]
        wanted = {"S_mean_um": row["S_mean_um"], "S_std_um": row["S_std_um"], "max_um": row["max_abs_um"], "n_tsp": 2}
        assert {k: run.metrics[k] for k in wanted} == pytest.approx(wanted, rel=1e-4)
        assert run.metrics["score_um"] == pytest.approx(scores[cell], rel=1e-4)
        assert (run.params["selector"], run.params["family"], run.params["n_tsp"]) == (*cell[:2], "2")


def test_the_page_of_an_experiment_leads_to_the_list_with_the_right_columns(logged):
    settings, training_id, _ = logged
    client = client_of(settings)
    experiment = client.get_experiment(client.get_run(training_id).info.experiment_id)
    key = "mlflow.sharedViewState.trainings"
    link = f"(#/experiments/{experiment.experiment_id}/runs?viewStateShareKey=trainings&workflowType=machine_learning)"
    assert link in experiment.tags["mlflow.note.content"]
    run = client.get_run(training_id).data
    shown = [c.partition(".")[::2] for c in json.loads(experiment.tags[key])["selectedColumns"]]
    metrics = {name.strip("`") for kind, name in shown if kind == "metrics"}
    assert metrics <= set(run.metrics)
    assert {name.strip("`") for kind, name in shown if kind == "params"} <= set(run.params)
    assert run.tags["mlflow.runName"] == "1.5 ± 0.5 µm mlr 2 none"


def test_an_experiment_follows_the_settings_and_keeps_the_note_of_a_user(store):
    client = client_of(store)
    slash = replace(store, names=NamesPart(experiment="{machine}/{target}"))
    first = runs.experiment_id(client, slash, "toy-renamed", "z", True)
    client.set_experiment_tag(first, "mlflow.note.content", "in hall 3")
    assert runs.experiment_id(client, store, "toy-renamed", "z", True) == first
    experiment = client.get_experiment(first)
    assert (experiment.name, experiment.tags["mlflow.note.content"]) == ("toy-renamed z", "in hall 3")
    assert runs.find_experiment(client, slash, "toy-renamed", "z").experiment_id == first


def test_versions_of_a_model_are_found_also_where_its_name_has_a_quote(store) -> None:
    client = tracking.open_store(store)
    for name in ("quoted-z'", "quoted-z"):
        client.create_registered_model(name)
        for _ in range(2):
            client.create_model_version(name, "/somewhere")
    assert [int(v.version) for v in runs.model_versions(client, "quoted-z'")] == [2, 1]
    found = runs.versions_by_model(client)
    assert [int(v.version) for v in found["quoted-z'"]] == [int(v.version) for v in found["quoted-z"]] == [2, 1]


def test_an_experiment_is_found_by_what_it_is_of_also_where_that_has_a_quote(store) -> None:
    client = tracking.open_store(store)
    ids = {t: runs.experiment_id(client, store, "toy-quoted", t, True) for t in ("z'", "z")}
    renamed = replace(store, names=NamesPart(experiment="{machine} by {target}"))
    for target, own in ids.items():
        found = runs.find_experiment(client, renamed, "toy-quoted", target)
        assert found is not None and found.experiment_id == own


def test_a_run_says_who_made_it_with_which_program_and_in_which_process(logged, monkeypatch):
    settings, training_id, _ = logged
    tags = client_of(settings).get_run(training_id).data.tags
    assert tags["mlflow.user"] == audit.who() and tags["mlflow.source.type"] == "LOCAL"
    assert tags["mlflow.source.name"] == "thermodrift"  # a test is another program
    program, _, commit = runs.code_version().partition(" ")
    assert tags.get("mlflow.source.git.commit", "") == (commit.removesuffix("-dirty") if program == "git" else "")
    process = json.loads(tags["process"])
    assert (process["host"], process["pid"]) == (platform.node(), os.getpid())
    monkeypatch.setattr(sys, "argv", ["/somewhere/bin/thermodrift", "train", "--machine", "x.yml"])
    assert runs.origin()["mlflow.source.name"] == "thermodrift train"


def test_a_checkout_is_known_by_its_commit():
    if not (ROOT / ".git").exists() or shutil.which("git") is None:
        pytest.skip("no checkout, or git is not installed")
    said = subprocess.run(["git", "-C", str(ROOT), "rev-parse", "HEAD"], capture_output=True, text=True)
    if said.returncode:
        pytest.skip(f"git refuses this checkout: {said.stderr.strip()}")
    assert runs.code_version().removesuffix("-dirty") == f"git {said.stdout.strip()}"


def test_the_parent_carries_batches_figures_and_the_best(logged):
    settings, training_id, result = logged
    run = client_of(settings).get_run(training_id)
    assert run.info.status == "FINISHED"
    assert run.data.tags["best"] == "mlr on 2 points by none"
    inputs = {i.dataset.name: i for i in run.inputs.dataset_inputs}
    assert list(inputs) == ["b00", "b01", "b02"]
    tags = {t.key: t.value for t in inputs["b01"].tags}
    assert tags["digest"] == result.batches["digest"][1]
    folder = mlflow.artifacts.download_artifacts(run_id=training_id, tracking_uri=settings.store_uri)
    assert (Path(folder) / "figures" / "heat.png").read_bytes().startswith(b"\x89PNG")


def test_simulated_is_written_on_experiment_and_every_run(logged):
    settings, training_id, _ = logged
    client = client_of(settings)
    run = client.get_run(training_id)
    experiment = client.get_experiment(run.info.experiment_id)
    assert experiment.name == "toy-tracked z"
    assert experiment.tags["simulated"] == "true"
    assert all(r.data.tags["simulated"] == "true" for r in [run, *children(settings, training_id).values()])


def test_a_training_comes_back_whole(logged):
    settings, training_id, result = logged
    got = tracking.load_training(training_id, settings)
    assert got.simulated
    assert got.promotion == {}
    chosen = {"selector": "none", "family": "mlr", "n_tsp": "2"}
    assert got.params.items() >= {"seed": "0", **chosen}.items() and set(got.params) == {"seed", "inputs", *chosen}
    for table in ("batches", "scores", "cells", "subsets", "predictions"):
        pd.testing.assert_frame_equal(getattr(got.result, table), getattr(result, table), check_dtype=False)


def test_trainings_are_listed_newest_first(logged):
    settings, training_id, _ = logged
    later = log_training(toy_result(toy_batches("toy-tracked", 3), S_UM), settings)
    table = tracking.trainings("toy-tracked", "z", settings)
    assert table["training_id"].tolist() == [later, training_id]
    assert table["n_batches"].tolist() == [3, 3]
    least = judged(toy_result(toy_batches("toy-tracked", 3), S_UM), settings.promotion).set_index("family").loc["mlr"]
    assert table["score_um"][0] == pytest.approx(least["score_um"].min(), rel=1e-4)
    assert tracking.trainings("nobody", None, settings).empty


def test_an_unfinished_training_is_not_listed(store, monkeypatch):
    def broken(*_: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr(MlflowClient, "log_artifacts", broken)
    with pytest.raises(OSError, match="disk full"):
        log_training(toy_result(toy_batches("toy-broken", 3), S_UM), store)
    assert tracking.trainings("toy-broken", None, store).empty


def test_an_unknown_training_is_told(logged):
    settings, training_id, _ = logged
    with pytest.raises(InputError, match="training 'nonsense' is not in"):
        tracking.load_training("nonsense", settings)
    child = next(iter(children(settings, training_id).values()))
    with pytest.raises(InputError, match="is not in"):  # a model's run is no training
        tracking.load_training(child.info.run_id, settings)


def test_the_first_use_is_said_and_a_broken_store_is_told(tmp_path, monkeypatch):
    said: list[str] = []
    file = tmp_path / "mlflow.db"
    file.write_bytes(b"no database at all, but long enough to be looked at as one" * 40)
    settings = Settings(tmp_path, f"sqlite:///{file}", None, NamesPart(), PromotionRule())
    monkeypatch.setattr(tracking, "MlflowClient", FakeClient)
    tracking.open_store(settings, said.append)
    assert said == []
    file.unlink()
    tracking.open_store(settings, said.append)
    assert said == [f"first use: making the tracking store {file} (takes some seconds, once)"]
    monkeypatch.setattr(FakeClient, "trouble", "no such table: experiments\n(Background …)")
    with pytest.raises(WorkError) as caught:
        tracking.open_store(settings)
    assert str(caught.value) == f"tracking store sqlite:///{file}: no such table: experiments"
    monkeypatch.setattr(FakeClient, "trouble", "Detected out-of-date database schema (found version 1)")
    with pytest.raises(WorkError, match=r"of an older MLflow; .* mlflow db upgrade sqlite"):
        tracking.open_store(settings)


class FakeClient:
    trouble = ""

    def __init__(self, store: str, **_: object) -> None:
        Path(store.removeprefix("sqlite:///")).touch()  # as the first use of a store makes its file

    def search_experiments(self, **_: object) -> list[object]:
        if self.trouble:
            raise mlflow.exceptions.MlflowException(self.trouble)
        return []


@pytest.mark.parametrize("target", ["Spindel vorn 50 %", "%2e%2e%2f%2e%2e%2foutside"])
def test_artifacts_stay_in_the_folder_of_their_channel(store, tmp_path, target):
    """A store decodes the address of an experiment, so that an unquoted name may lead out of its folder."""
    client = client_of(store)
    (tmp_path / "note.txt").write_text("x")
    run = client.create_run(runs.experiment_id(client, store, "toy-quoted", target, True))
    client.log_artifact(run.info.run_id, str(tmp_path / "note.txt"))
    (note,) = store.home.rglob(f"{run.info.run_id}/**/note.txt")
    assert note.relative_to(store.home / "artifacts" / "toy-quoted").parts[0] == target


def test_a_full_disk_is_that_of_the_home_and_not_the_source_of_the_copy(store, tmp_path):
    full = OSError(errno.ENOSPC, "No space left on device", "/tmp/scratch/scores", None, f"{tmp_path}/scores")
    with pytest.raises(WorkError, match=f"^{tmp_path}/scores: cannot be written or read"), tracking.store_errors(store):
        raise full
