from __future__ import annotations

from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import mlflow
import pytest
from mlflow.tracking import MlflowClient

from diagnosis.result import Diagnosis
from pipelines.settings import Settings
from pipelines.store import tracking
from pipelines.store.tracking import diagnoses
from tests.toys.diagnosis import toy_diagnosis
from tests.toys.tracked import log_diagnosis
from tests.toys.training import toy_batches

MACHINE = "sample_vmc"


def run_of(store: Settings, run_id: str) -> Any:
    return MlflowClient(store.store_uri).get_run(run_id)


@pytest.fixture(scope="module")
def logged(store: Any, tmp_path_factory: pytest.TempPathFactory) -> tuple[Settings, str, Diagnosis]:
    out = tmp_path_factory.mktemp("out")
    files = {name: out / name for name in ("findings.json", "machine.yml", "report.html")}
    for name, path in files.items():
        path.write_text(f"this is {name}", encoding="utf-8")
    d = toy_diagnosis("partly_explained")
    return store, log_diagnosis(d, toy_batches(MACHINE, 3), files, store, params={"seed": 5}), d


def test_a_run_says_what_was_found_from_what(logged: Any) -> None:
    store, run_id, d = logged
    run = run_of(store, run_id)
    assert run.info.status == "FINISHED"
    wanted = {"kind": "diagnosis", "verdict": "partly_explained", "mechanism": "floor_sink", "where": "node bed",
              "simulated": "true", "drafted": "false", "machine": MACHINE}  # fmt: skip
    assert wanted.items() <= run.data.tags.items()
    params = run.data.params
    assert (params["machine"], params["seed"], params["batches"]) == (MACHINE, "5", ", ".join(d.findings.batches))
    assert params["version.thermodrift"] == version("thermodrift") and params["version.python"].startswith("3.")
    metrics, rms = run.data.metrics, d.findings.fit.left_out_rms
    for group, values in (("left_out_rms_before", rms.before), ("left_out_rms_after", rms.after),
                          ("noise_floor", rms.noise_floor)):  # fmt: skip
        assert values and {f"{group}/{k}": v for k, v in values.items()}.items() <= metrics.items()
    figures = {"findings": 2, "probability": 0.97, "batches": 12, "left_out_batches_improved": 10, "seconds": 24.3}
    assert figures.items() <= metrics.items()


def test_the_files_and_the_batches_are_with_it(logged: Any, tmp_path: Path) -> None:
    store, run_id, _ = logged
    folder = mlflow.artifacts.download_artifacts(run_id=run_id, tracking_uri=store.store_uri, dst_path=str(tmp_path))
    held = {p.name: p.read_text(encoding="utf-8") for p in Path(folder).iterdir()}
    assert held == {name: f"this is {name}" for name in ("findings.json", "machine.yml", "report.html")}
    inputs = run_of(store, run_id).inputs.dataset_inputs
    assert [i.dataset.name for i in inputs] == ["b00", "b01", "b02"]
    assert {t.value for i in inputs for t in i.tags if t.key == "mlflow.data.context"} == {"diagnosis"}


def test_its_experiment_carries_the_machines_name_and_is_no_training(logged: Any) -> None:
    store, run_id, _ = logged
    experiment = MlflowClient(store.store_uri).get_experiment(run_of(store, run_id).info.experiment_id)
    assert experiment.name == f"{MACHINE} diagnosis" and experiment.tags["simulated"] == "true"
    assert run_id not in tracking.trainings(settings=store)["training_id"].tolist()


def test_diagnoses_are_listed_newest_first(logged: Any) -> None:
    store, run_id, _ = logged
    later = log_diagnosis(toy_diagnosis("consistent"), [], {}, store)
    table = diagnoses(MACHINE, store)
    assert table["run_id"].tolist() == [later, run_id]
    assert table["verdict"].tolist() == ["consistent", "partly_explained"]
    assert table["mechanism"].tolist() == ["", "floor_sink"] and table["where"].tolist() == ["", "node bed"]
    assert table["n_batches"].tolist() == [12, 12] and table["probability"].isna().tolist() == [True, False]
    assert diagnoses("nobody", store).empty


def test_a_diagnosis_that_could_not_be_kept_is_not_listed(store: Any, tmp_path: Path) -> None:
    before = len(diagnoses(settings=store))
    with pytest.raises(OSError, match=r"gone\.html"):
        log_diagnosis(toy_diagnosis("explained"), [], {"report.html": tmp_path / "gone.html"}, store)
    assert len(diagnoses(settings=store)) == before


def test_more_channels_than_the_store_takes_at_once(store: Any) -> None:
    d = toy_diagnosis("consistent")
    many = {f"t{k}_K": 0.1 * k for k in range(500)} | {"t no. 7 (left)_K": 7.0}
    rms = d.findings.fit.left_out_rms.model_copy(update={"before": many, "after": many})
    fit = d.findings.fit.model_copy(update={"left_out_rms": rms})
    run_id = log_diagnosis(replace(d, findings=d.findings.model_copy(update={"fit": fit})), [], {}, store)
    metrics = run_of(store, run_id).data.metrics
    assert metrics["left_out_rms_after/t499_K"] == pytest.approx(49.9)
    assert metrics["left_out_rms_before/t no. 7 _left__K"] == 7.0
