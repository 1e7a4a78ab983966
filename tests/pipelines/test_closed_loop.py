"""The closed loop through a broker: a plant, `thermodrift compensate` in its own process, mosquitto between them."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from data.machine import load_machine
from pipelines.cli import app
from tests.compensation.test_mqtt import BROKER, Broker
from tests.pipelines.test_compensating import INPUTS, last_recording, store_model
from tests.toys.small_year import write_machine, write_year

pytestmark = [
    pytest.mark.integration,
    pytest.mark.slow,
    pytest.mark.skipif(BROKER is None, reason="needs the broker mosquitto: apt-get install mosquitto"),
]
ROOT = Path(__file__).parents[2]


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Broker]:
    made = Broker(tmp_path, "allow_anonymous true\n")
    yield made
    made.stop()


def test_a_plant_is_compensated_through_a_broker(broker: Broker, tmp_path: Path) -> None:
    write_year(tmp_path / "in", 7)
    write_machine(tmp_path / "m.yml", "mill")
    store_model(tmp_path, tmp_path / "model")
    assert set(INPUTS) <= set(load_machine(tmp_path / "m.yml").channels)
    options = ["--period-s", "120", "--sample-s", "120", "--rate-um-per-s", "1"]
    command = [sys.executable, "-m", "pipelines.cli", "compensate", str(tmp_path / "model"), "--replay", "--from",
               broker.address, "--to", broker.address, "--state", str(tmp_path / "state.json"), *options]  # fmt: skip
    env = {**os.environ, "THERMODRIFT_HOME": str(tmp_path / "home")}
    beside = subprocess.Popen(command, cwd=ROOT, env=env, stderr=subprocess.PIPE, text=True)
    try:
        rehearse = ["rehearse", str(tmp_path / "model"), "--recordings", str(last_recording(tmp_path)), "--json"]
        rehearse += ["--fail", "front:lost@2h+20min", "--readings-h", "1", "--out", str(tmp_path / "page.html")]
        here = CliRunner().invoke(app, [*rehearse, *options])
        there = CliRunner().invoke(app, [*rehearse, *options, "--through", broker.address])
    finally:
        beside.send_signal(signal.SIGINT)
        error = beside.communicate(timeout=60)[1]
    assert there.exit_code == 0, (there.output, there.exception, error)
    assert here.exit_code == 0 and "Traceback" not in error
    told, own = json.loads(there.stdout), json.loads(here.stdout)
    assert told["samples"] == 181
    for name, value in own["axes"]["z"].items():
        assert told["axes"]["z"][name] == pytest.approx(value, rel=1e-6), name
    assert json.loads((tmp_path / "state.json").read_text())["state"]["machine"] == "mill"
