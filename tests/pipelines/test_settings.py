from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from data.errors import InputError
from data.yaml_file import load_yaml
from pipelines import settings

ROOT = Path(__file__).parents[2]


def test_the_projects_file_states_the_defaults():
    written = load_yaml(ROOT / "mlflow.yml", settings._File, "settings file")
    assert written == settings._File()


def test_home_comes_from_the_environment_else_from_the_working_directory(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("THERMODRIFT_HOME", str(tmp_path / "elsewhere"))
    assert settings.home() == tmp_path / "elsewhere"
    assert settings.load().store_file == tmp_path / "elsewhere" / "mlflow.db"
    monkeypatch.delenv("THERMODRIFT_HOME")
    assert settings.home() == tmp_path / "var" and not settings.home().exists()


def test_settings_come_from_the_working_directory_else_from_the_defaults(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert settings.load().model("vmc", "z") == "vmc-z"
    (tmp_path / "mlflow.yml").write_text('names: {model: "{target}.{machine}"}\n')
    assert settings.load().model("vmc", "z") == "z.vmc"


def test_names_follow_the_patterns(tmp_path):
    file = tmp_path / "m.yml"
    file.write_text('names: {model: "{target}.{machine}"}\n')
    loaded = settings.load(file)
    assert loaded.model("vmc", "z") == "z.vmc"
    assert loaded.experiment("vmc", "z") == "vmc z"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("promotion: {ties_s: 3}", "unknown key 'promotion.ties_s'; did you mean 'ties_se'?"),
        ("promtion: {}", "unknown key 'promtion'; did you mean 'promotion'?"),
        ("promotion: {protocols: {leave-batch-in: 1}}", "did you mean 'leave-batch-out'?"),
        ("promotion: {significance: 2}", "key 'promotion.significance': got 2;"),
        ('names: {model: "{machine}"}', "placeholder {target} is missing"),
        ('names: {model: "{machine}/{target}"}', "must not contain / or :"),
        ('names: {experiment: "{machina}/{target}"}', "did you mean 'machine'?"),
        ('tracking: {store: "sqlite:///mlflow.db"}', "needs an absolute path"),
        ("a: [", "not valid YAML"),
        ("- a", "expected a mapping"),
    ],
)
def test_a_wrong_file_is_told_in_one_line(tmp_path, text, words):
    file = tmp_path / "m.yml"
    file.write_text(text)
    with pytest.raises(InputError) as caught:
        settings.load(file)
    assert words in str(caught.value)
    assert str(file) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_told(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        settings.load(tmp_path / "none.yml")


@pytest.mark.integration
def test_both_libraries_take_telemetry_as_off_and_prefect_lives_below_home(tmp_path):
    """Asked from the libraries themselves, in a process of its own."""
    code = (
        "from pipelines.settings import configure_environment\n"
        "configure_environment()\n"
        "import mlflow.telemetry.utils as m\n"
        "assert m.MLFLOW_DISABLE_TELEMETRY.get() is True\n"
        "assert m.is_telemetry_disabled()\n"
        "from prefect._internal.analytics.enabled import is_telemetry_enabled\n"
        "from prefect.settings import get_current_settings\n"
        "s = get_current_settings()\n"
        "assert not is_telemetry_enabled()\n"
        "assert not s.server.analytics_enabled and not s.telemetry.enable_resource_metrics\n"
        "print(s.home)\n"
    )
    hidden = ("CI", "PYTEST_CURRENT_TEST", "PREFECT_HOME", "DO_NOT_TRACK", "MLFLOW_DISABLE_TELEMETRY")
    clean = {k: v for k, v in os.environ.items() if k not in hidden}
    done = subprocess.run(
        [sys.executable, "-c", code], env={**clean, "THERMODRIFT_HOME": str(tmp_path)}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert Path(done.stdout.strip()) == tmp_path / "prefect"


def test_a_prefect_home_of_the_user_stays(monkeypatch, tmp_path):
    monkeypatch.setenv("PREFECT_HOME", str(tmp_path))
    settings.configure_environment()
    assert os.environ["PREFECT_HOME"] == str(tmp_path)
