"""`mlflow.yml`: store, names and rules; and the home folder, which everything is written to.

Both are looked for in the working directory, never in the installation: `var/` is the home unless THERMODRIFT_HOME
names another folder; without an `mlflow.yml` the defaults below hold. An address may take parts, such as a password,
from the environment: ``{env:NAME}``. What is shown of an address is `masked`.
"""

from __future__ import annotations

import os
import string
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, field_validator

from data.errors import InputError, closest
from data.errors import masked as masked
from data.yaml_file import load_yaml
from models.protocols import PromotionRule
from pipelines import TELEMETRY_OFF
from pipelines.home import home as home

FILE = "mlflow.yml"
_prefect_home_set_here = ""


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


def _only_home_and_environment(value: str | None) -> str | None:
    return None if value is None else _placeholders(value, {"home", "env"}, set())


class TrackingPart(_Part):
    """Where runs and their files go; `{home}` stands for `home()`, `{env:NAME}` for a variable of the environment."""

    store: str = "sqlite:///{home}/mlflow.db"
    artifacts: str | None = "{home}/artifacts"

    _addresses = field_validator("store", "artifacts")(_only_home_and_environment)


class NamesPart(_Part):
    """Patterns of names; both carry `{machine}` and `{target}`."""

    experiment: str = "{machine} {target}"
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
    lake: str = "{home}/lake"
    lake_key: str = ""
    tracking: TrackingPart = TrackingPart()
    names: NamesPart = NamesPart()
    promotion: PromotionRule = PromotionRule()
    diagnose: DiagnoseRule = DiagnoseRule()

    _address = field_validator("lake", "lake_key")(_only_home_and_environment)


@dataclass(frozen=True)
class Settings:
    """`mlflow.yml` with the home folder and the environment filled in.

    `store_uri` may hold a password; what people read gets `store_name`. `lake` is a folder, or an address;
    `lake_key` signs its manifests.
    """

    home: Path
    store_uri: str = field(repr=False)
    artifacts_uri: str | None = field(repr=False)
    names: NamesPart
    promotion: PromotionRule
    diagnose: DiagnoseRule = field(default_factory=DiagnoseRule)
    lake: str = field(default="", repr=False)
    lake_key: str = field(default="", repr=False)

    @property
    def store_name(self) -> str:
        """The address of the store without its password."""
        return masked(self.store_uri)

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


def configure_environment() -> None:
    """Telemetry of mlflow and prefect off and PREFECT_HOME below `home()`; call it before prefect is imported.

    A PREFECT_HOME that the user set stays. Log levels are set when `pipelines` is imported.

    Raises:
        InputError: PREFECT_HOME is no folder and none can be made.
    """
    global _prefect_home_set_here
    os.environ.update(TELEMETRY_OFF)
    if os.environ.get("PREFECT_HOME", "") in ("", _prefect_home_set_here):
        _prefect_home_set_here = os.environ["PREFECT_HOME"] = str(home() / "prefect")
    # Prefect makes its folder but not the one above it; its server then stops without a message.
    folder, name = Path(os.environ["PREFECT_HOME"]).expanduser(), "PREFECT_HOME"
    name = "THERMODRIFT_HOME" if os.environ["PREFECT_HOME"] == _prefect_home_set_here else name
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (FileNotFoundError, FileExistsError, NotADirectoryError) as error:
        raise InputError(f"{folder}: no folder can be made there ({error.strerror}); let {name} name another") from None


def load(path: Path | str | None = None) -> Settings:
    """Read and check a settings file; without a path the working directory's `mlflow.yml`, or the defaults.

    Raises:
        InputError: file missing, not YAML, an unknown key (with the closest), a wrong value; one line each.
    """
    where = Path(path or FILE)
    parsed = _File() if path is None and not where.exists() else load_yaml(where, _File, "settings file")
    base = home()
    store = _filled(parsed.tracking.store, base, f"settings file {where}: key 'tracking.store'")
    if store.startswith("sqlite:") and not Path(store.removeprefix("sqlite:///")).is_absolute():
        raise InputError(
            f"settings file {where}: key 'tracking.store': got {store!r}; a SQLite store needs an absolute path, "
            "for example sqlite:///{home}/mlflow.db"
        )
    artifacts = parsed.tracking.artifacts
    if artifacts is not None:
        artifacts = _filled(artifacts, base, f"settings file {where}: key 'tracking.artifacts'")
        artifacts = artifacts if "://" in artifacts else (base / artifacts).as_uri()
    lake = os.environ.get("THERMODRIFT_LAKE", "").strip() or _filled(
        parsed.lake, base, f"settings file {where}: key 'lake'"
    )
    lake = lake if "://" in lake else str(base / Path(lake).expanduser())
    key = _filled(parsed.lake_key, base, f"settings file {where}: key 'lake_key'")
    return Settings(base, store, artifacts, parsed.names, parsed.promotion, parsed.diagnose, lake, key)


class _Environment:
    """In a format string, ``{env:NAME}`` is the value of the variable NAME."""

    def __init__(self, where: str) -> None:
        self._where = where

    def __format__(self, name: str) -> str:
        if not os.environ.get(name):
            raise InputError(
                f"{self._where}: environment variable {name} is not set; set it, or leave {{env:{name}}} out"
            )
        return os.environ[name]


def _filled(address: str, base: Path, where: str) -> str:
    return address.format(home=base.as_posix(), env=_Environment(where))


def _placeholders(value: str, allowed: set[str], needed: set[str]) -> str:
    parts = [(name, spec) for _, name, spec, _ in string.Formatter().parse(value) if name is not None]
    if any((name == "env") != bool(spec) for name, spec in parts):
        raise ValueError("only {env:NAME}, a variable of the environment, has a colon, and it needs a NAME")
    found = {name for name, _ in parts}
    if found - allowed:
        unknown = sorted(found - allowed)[0]
        raise ValueError(f"unknown placeholder {{{unknown}}}; {closest(unknown, allowed)}")
    if needed - found:
        raise ValueError(f"placeholder {{{sorted(needed - found)[0]}}} is missing")
    return value
