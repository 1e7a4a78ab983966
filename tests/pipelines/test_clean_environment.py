"""A promoted model in a fresh virtual environment with mlflow, numpy, pandas and onnxruntime alone: minutes, -m slow.

.venv/bin/python -m pytest -m slow tests/pipelines/test_clean_environment.py
"""

from __future__ import annotations

import io
import json
import os
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from models.selection.promotion import choose
from pipelines.commands.predict import load_model
from pipelines.store import registry
from pipelines.store.model_store import predict_frame
from tests.toys.tracked import log_training
from tests.toys.training import machine_yaml, toy_batches, toy_model, toy_result

pytestmark = [pytest.mark.integration, pytest.mark.slow]
PACKAGES = ("mlflow", "numpy", "pandas", "onnxruntime")
TIMEOUT_S = 120.0


@pytest.fixture(scope="module")
def clean(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The interpreter of an environment in which thermodrift is not installed."""
    folder = tmp_path_factory.mktemp("clean") / "venv"
    subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True)
    pins = [f"{p}=={version(p)}" for p in PACKAGES]
    subprocess.run([folder / "bin" / "pip", "install", "--quiet", *pins], check=True)
    return folder / "bin" / "python"


@pytest.fixture(scope="module")
def name(store: Any) -> str:
    batches = toy_batches("toy-clean", 6)
    result = toy_result(batches, {"none|mlr|2": [1.0] * 6})
    model, region = toy_model(batches)
    training_id = log_training(result, store)
    choice = choose(result, store.promotion)
    new = registry.Newcomer(result, choice, model, machine_yaml("toy-clean"), training_id, region, batches)
    return registry.promote(new, store).name


def environment(store: Any) -> dict[str, str]:
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("MLFLOW_", "PYTHON", "THERMODRIFT"))}
    return kept | {"MLFLOW_TRACKING_URI": store.store_uri, "MLFLOW_DISABLE_TELEMETRY": "true"}


def rows(store: Any, name: str) -> tuple[pd.DataFrame, pd.DataFrame]:
    table = toy_batches("toy-clean", 3)[2].table.drop(columns="z")
    return table, predict_frame(load_model(f"models:/{name}@champion", store), table)


def test_it_loads_and_predicts(clean: Path, store: Any, name: str, tmp_path: Path) -> None:
    table, wanted = rows(store, name)
    table.to_csv(tmp_path / "rows.csv", index=False)
    code = (
        "import mlflow, pandas, sys\n"
        f"model = mlflow.pyfunc.load_model('models:/{name}@champion')\n"
        "sys.stdout.write('ANSWER' + model.predict(pandas.read_csv('rows.csv')).to_csv(index=False))\n"
        "assert 'pipelines' not in sys.modules and 'scipy' not in {m for m in sys.modules if m == 'pipelines'}\n"
    )
    done = subprocess.run([clean, "-c", code], cwd=tmp_path, env=environment(store), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    got = pd.read_csv(io.StringIO(done.stdout.partition("ANSWER")[2]))
    assert np.abs(got["predicted_um"] - wanted["predicted_um"].to_numpy()).max() < 1e-4
    assert (got["outside_region"] == wanted["outside_region"].to_numpy()).all()


def test_it_is_served_over_http(clean: Path, store: Any, name: str, tmp_path: Path) -> None:
    table, wanted = rows(store, name)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [clean, "-m", "mlflow", "models", "serve", "-m", f"models:/{name}@champion", "-h", "127.0.0.1", "-p",
               str(port), "--env-manager", "local"]  # fmt: skip
    environ = environment(store) | {"PATH": f"{clean.parent}:{os.environ['PATH']}"}
    server = subprocess.Popen(command, cwd=tmp_path, env=environ, start_new_session=True)
    try:
        body = json.dumps({"dataframe_split": {"columns": list(table), "data": table.to_numpy().tolist()}})
        request = urllib.request.Request(
            f"http://127.0.0.1:{port}/invocations", body.encode(), {"Content-Type": "application/json"}
        )
        until_s = time.monotonic() + TIMEOUT_S
        while True:
            try:
                answer = json.loads(urllib.request.urlopen(request, timeout=30).read())
                break
            except (urllib.error.URLError, ConnectionError):
                assert server.poll() is None and time.monotonic() < until_s
                time.sleep(0.5)
    finally:
        os.killpg(server.pid, 15)
        server.wait()
    got = pd.DataFrame(answer["predictions"])
    assert np.abs(got["predicted_um"].to_numpy() - wanted["predicted_um"].to_numpy()).max() < 1e-4
