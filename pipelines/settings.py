"""`mlflow.yml`: store, names and rules; and the home folder, which everything is written to.

Both are looked for in the working directory, never in the installation: `var/` is the home unless THERMODRIFT_HOME
names another folder; without an `mlflow.yml` the defaults below hold.
"""

from __future__ import annotations

import os
import string
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, field_validator

from data.errors import InputError, closest
from data.yaml_file import load_yaml
from models.protocols import PromotionRule
from pipelines import TELEMETRY_OFF

FILE = "mlflow.yml"
_prefect_home_set_here = ""


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class TrackingPart(_Part):
    """Where runs and their files go; `{home}` stands for `home()`."""

    store: str = "sqlite:///{home}/mlflow.db"
    artifacts: str | None = "{home}/artifacts"

    @field_validator("store", "artifacts")
    @classmethod
    def _only_home(cls, value: str | None) -> str | None:
        return None if value is None else _placeholders(value, {"home"}, set())


class NamesPart(_Part):
    """Patterns of names; both carry `{machine}` and `{target}`."""

    experiment: str = "{machine}/{target}"
    model: str = "{machine}-{target}"

    @field_validator("experiment", "model")
    @classmethod
    def _both(cls, value: str) -> str:
        return _placeholders(value, {"machine", "target"}, {"machine", "target"})

    @field_validator("model")
    @classmethod
    def _no_separator(cls, value: str) -> str:
        if "/" in value or ":" in value:
            raise ValueError("a registered model's name must not contain / or :")
        return value


class DiagnoseRule(_Part):
    """When a training is followed by a diagnosis: growth of a twin family's left-out error as a share, None: never."""

    when_error_grows_by: Annotated[float, Field(gt=0)] | None = 0.25


class _File(_Part):
    tracking: TrackingPart = TrackingPart()
    names: NamesPart = NamesPart()
    promotion: PromotionRule = PromotionRule()
    diagnose: DiagnoseRule = DiagnoseRule()


@dataclass(frozen=True)
class Settings:
    """`mlflow.yml` with the home folder filled in."""

    home: Path
    store_uri: str
    artifacts_uri: str | None
    names: NamesPart
    promotion: PromotionRule
    diagnose: DiagnoseRule = field(default_factory=DiagnoseRule)

    def experiment(self, machine: str, target: str) -> str:
        """Name of the experiment of one machine's error channel."""
        return self.names.experiment.format(machine=machine, target=target)

    def model(self, machine: str, target: str) -> str:
        """Name of the registered model of one machine's error channel."""
        return self.names.model.format(machine=machine, target=target)

    @property
    def store_file(self) -> Path | None:
        """The SQLite file of the store, None for a server."""
        return Path(self.store_uri.removeprefix("sqlite:///")) if self.store_uri.startswith("sqlite:") else None


def home() -> Path:
    """The folder that everything is written to: THERMODRIFT_HOME, else var/ in the working directory; absolute."""
    return Path(os.environ.get("THERMODRIFT_HOME", "").strip() or "var").expanduser().resolve()


def configure_environment() -> None:
    """Telemetry of mlflow and prefect off and PREFECT_HOME below `home()`; call it before prefect is imported.

    A PREFECT_HOME that the user set stays. Log levels are set when `pipelines` is imported.
    """
    global _prefect_home_set_here
    os.environ.update(TELEMETRY_OFF)
    if os.environ.get("PREFECT_HOME", "") in ("", _prefect_home_set_here):
        _prefect_home_set_here = os.environ["PREFECT_HOME"] = str(home() / "prefect")
    # Prefect makes its folder but not the one above it; its server then stops without a message.
    Path(os.environ["PREFECT_HOME"]).expanduser().mkdir(parents=True, exist_ok=True)


def load(path: Path | str | None = None) -> Settings:
    """Read and check a settings file; without a path the working directory's `mlflow.yml`, or the defaults.

    Raises:
        InputError: file missing, not YAML, an unknown key (with the closest), a wrong value; one line each.
    """
    where = Path(path or FILE)
    parsed = _File() if path is None and not where.exists() else load_yaml(where, _File, "settings file")
    base = home()
    store = parsed.tracking.store.format(home=base.as_posix())
    if store.startswith("sqlite:") and not Path(store.removeprefix("sqlite:///")).is_absolute():
        raise InputError(
            f"settings file {where}: key 'tracking.store': got {store!r}; a SQLite store needs an absolute path, "
            "for example sqlite:///{home}/mlflow.db"
        )
    artifacts = parsed.tracking.artifacts
    if artifacts is not None:
        artifacts = artifacts.format(home=base.as_posix())
        artifacts = artifacts if "://" in artifacts else (base / artifacts).as_uri()
    return Settings(base, store, artifacts, parsed.names, parsed.promotion, parsed.diagnose)


def _placeholders(value: str, allowed: set[str], needed: set[str]) -> str:
    found = {name for _, name, _, _ in string.Formatter().parse(value) if name is not None}
    if found - allowed:
        unknown = sorted(found - allowed)[0]
        raise ValueError(f"unknown placeholder {{{unknown}}}; {closest(unknown, allowed)}")
    if needed - found:
        raise ValueError(f"placeholder {{{sorted(needed - found)[0]}}} is missing")
    return value
