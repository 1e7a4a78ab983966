"""A fitted model as plain data: `model.json`, `arrays.npz` and the `machine.yml` it belongs to. Never pickle.

A stored model needs neither MLflow nor the recordings: `load(folder).predict(batch)`.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args
from zipfile import BadZipFile

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from compensation.substitutes import Substitutes
from data.arrays import Array
from data.batch import Batch
from data.errors import InputError, one_of
from data.files import from_json
from data.machine import Machine, parse_machine
from models.base import Family, family_from_plain
from models.selection.conformal import RunBound
from models.selection.trust import SLACK, Region, disagreement_um, farthest, watched, worth
from models.selection.updating import Updater
from pipelines.store.audit import CHAMPION

SCHEMA = "thermodrift.model/3"
_READABLE = ("thermodrift.model/2", SCHEMA)  # /2 had no bounds of a run
_REGISTERED = re.compile(r"^models:/(?P<name>[^/@]+)(?:@(?P<alias>.+)|/(?P<version>.+))?$")
FILES = ("model.json", "arrays.npz", "machine.yml")
CODE = "pyfunc_model.py"  # by which MLflow loads a registered model, in the folder around the other files
SERVED = ("serving.json", "model.onnx", "region.onnx")  # only of families that are programs
Standing = Literal["champion", "provisional", "refused"]
_AGAIN = "load the model from the registry again, or promote it again"


class RunError(NamedTuple):
    """Expected S of a run and the bound that nine runs in ten stay below, µm; `flagged` is why the run is unlike the
    left-out runs that both come from (then the error may exceed the bound), empty where it is not."""

    expected_S_um: float
    bound90_S_um: float
    flagged: str


@dataclass(frozen=True)
class StoredModel:
    """A family ready to predict, the machine it is for, where it was trained, and what is known about it."""

    family: Family
    machine: Machine
    region: Region
    info: dict[str, Any] = field(default_factory=dict)  # training_id, cell, n_batches, simulated, …
    bound: RunBound | None = None  # of the error of a run
    siblings: tuple[Family, ...] = ()  # the best of other families, without those that `family` is made of
    updater: Updater | None = None  # of readings of a probe
    substitutes: Substitutes | None = None  # of failed sensors

    @property
    def simulated(self) -> bool:
        return bool(self.info.get("simulated", False))

    @property
    def standing(self) -> Standing:
        """What its forward runs have shown: fit to be champion, better than no model but not beyond doubt, or neither.

        Raises:
            InputError: another word, which a program of another version may have stored.
        """
        older = "refused" if self.info.get("trusted") is False else "champion"  # has no standing
        return one_of(str(self.info.get("standing", older)), get_args(Standing), "standing of a model")

    @property
    def authority(self) -> float:
        """Share of its correction that is sent. A refused model has none measured: by force it acts as a whole."""
        if self.standing == "refused":
            return 1.0
        return float(self.info.get("authority", 1.0 if self.standing == "champion" else 0.0))

    @property
    def remark(self) -> str:
        """What every record and file of it states; empty for a champion."""
        if self.standing == "provisional":
            return f"provisional model: {100 * self.authority:.3g} % of the correction"
        return "" if self.standing == "champion" else "refused model: not shown to be better than none"

    def channels(self) -> tuple[str, ...]:
        """The channels that a recording must have: those of the inputs, and what drives it as `fitted` names it."""
        drivers = self.machine.names("driver", "ambient", "temperature", "position")
        texts = (w for v in self.family.fitted.values() for w in (v if isinstance(v, list) else [v]))
        named = [w for w in texts if isinstance(w, str) and w in drivers]
        needed: dict[str, None] = {}
        for name in self.family.inputs:
            channel, _, kind = name.partition("@")
            needed[channel] = None
            if kind == "ambient":
                needed |= dict.fromkeys(self.machine.names("ambient")[:1])
        return tuple(needed | dict.fromkeys(named))

    def predict(self, batch: Batch) -> Array:
        """Error_um (n,) of a batch, relative to its start.

        Raises:
            InputError: an input is not in the batch, or was nowhere recorded.
        """
        absent = [c for c in self.channels() if c not in batch.table or not np.isfinite(batch.values(c)).any()]
        if absent:
            needed = ", ".join(f"{c!r} (column {self._column(c)!r})" for c in absent)
            have = [c for c in batch.names("temperature", "ambient", "driver") if c in batch.table]
            raise InputError(
                f"{batch.source or 'batch'} {batch.batch_id}: the model of {self.machine.machine} needs {needed}, "
                f"which the recording does not have; it has {', '.join(have) or 'no input at all'}; "
                "give a recording with every input, or a model with fewer"
            )
        return self.family.predict(batch)

    def outside(self, batch: Batch) -> list[str]:
        """Per row the inputs, drivers or start temperatures outside the trained region, joined by ", "."""
        out = [""] * batch.n_rows
        for name, hit in self.region.outside(batch, self.family.inputs).items():
            for i in np.flatnonzero(hit):
                out[i] += f", {name}" if out[i] else name
        return out

    def distance(self, batch: Batch) -> Array:
        """Distance of each row (n,) from the trained region, in trained widths; 0 inside, and where the region has no
        quantity; NaN where the batch has none of them."""
        values = watched(batch, self.family.inputs)
        if not any(name in values for name in self.region.ranges):
            return np.full(batch.n_rows, np.nan if self.region.ranges else 0.0)
        return self.region.distance(values)

    def weight(self, distance: Array) -> Array:
        """The share of the correction (n,) that is sent at a distance from the trained region."""
        tested = self.bound.tested if self.bound is not None else 0.0
        return np.minimum(self.authority, worth(np.nan_to_num(distance), tested))

    def run_error(self, batch: Batch, predicted_um: Array) -> RunError:
        """The error to expect of a run from its inputs and its prediction (n,)."""
        distance, quantity = farthest(self.region.beyond(values := watched(batch, self.family.inputs)))
        peers = self.family.parts() or self.siblings
        apart_um = disagreement_um(predicted_um, [p.predict(batch) for p in peers])
        bound = self.bound
        if bound is None:
            expected_um, most_um = (float(self.info.get(f"expected_S_{k}um", math.nan)) for k in ("", "bound90_"))
            return RunError(expected_um, most_um, self.region.excess(quantity, values) if distance > SLACK else "")
        factor, reasons = bound.factor(apart_um, distance), []
        if distance > max(bound.tested, SLACK):
            reasons.append(self.region.excess(quantity, values))
        if apart_um > bound.usual_um:
            reasons.append(f"other models differ by {apart_um:.2g} µm, usually {bound.typical_um:.2g}")
        return RunError(bound.expected_um * factor, bound.bound_um * factor, "; ".join(reasons))

    def _column(self, channel: str) -> str | int:
        part = self.machine.channels.get(channel)
        return channel if part is None or part.column is None else part.column


def registered(uri: str) -> tuple[str, str] | None:
    """Name, and alias or version (empty: see `lookups.which_of`), of ``models:/NAME@alias``. None: another form."""
    match = _REGISTERED.match(uri)
    return None if match is None else (match["name"], match["alias"] or match["version"] or "")


def is_champion(uri: str) -> bool:
    """Whether the champion of a registry is meant, as such; a name alone never leads to another refused model."""
    named = registered(uri)
    return named is not None and named[1] in (CHAMPION, "")


def save(
    folder: Path,
    family: Family,
    machine_yaml: str,
    region: Region,
    info: Mapping[str, Any] | None = None,
    bound: RunBound | None = None,
    siblings: Sequence[Family] = (),
    updater: Updater | None = None,
    substitutes: Substitutes | None = None,
) -> None:
    """Write the three files; `machine_yaml` is the text of the machine file.

    `model.json` holds the SHA-256 of the two others, which `load` verifies.
    """
    folder.mkdir(parents=True, exist_ok=True)
    arrays: dict[str, NDArray[Any]] = {}
    plain = _to_json(family.as_plain(), arrays)
    document = {
        "schema": SCHEMA,
        **plain,
        "region": _to_json(region.as_plain(), arrays),
        "bound": None if bound is None else _to_json(bound.as_plain(), arrays),
        "siblings": [_to_json(s.as_plain(), arrays) for s in siblings],
        "updater": None if updater is None else _to_json(updater.as_plain(), arrays),
        "substitutes": None if substitutes is None else _to_json(substitutes.as_plain(), arrays),
        "info": dict(info or {}),
    }
    np.savez(folder / "arrays.npz", allow_pickle=False, **arrays)
    (folder / "machine.yml").write_text(machine_yaml, encoding="utf-8")
    _write(folder, document, FILES[1:])


def add_hashes(folder: Path, names: Sequence[str]) -> None:
    """Note the SHA-256 of further files of a stored model, those by which it is served, in its `model.json`."""
    _write(folder, from_json((folder / "model.json").read_text(encoding="utf-8")), names)


def _write(folder: Path, document: dict[str, Any], names: Sequence[str]) -> None:
    hashes = {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in names}
    document["sha256"] = document.get("sha256", {}) | hashes
    (folder / "model.json").write_text(json.dumps(document, indent=1, ensure_ascii=False), encoding="utf-8")


def digest(folder: Path) -> str:
    """SHA-256 (hex) of `model.json`, which has those of the other files: it stands for all of a model."""
    return hashlib.sha256((inner_folder(folder) / "model.json").read_bytes()).hexdigest()


def verified(folder: Path, sha256: str) -> Path:
    """The folder of a registered model, whose `digest` the registry has as `sha256` (empty: an earlier program's).

    Raises:
        InputError: `model.json` is another one.
    """
    try:
        got = digest(folder) if sha256 else ""
    except OSError:
        return folder  # `load` says what is missing
    if got != sha256:
        raise InputError(
            f"model folder {folder}: model.json is not the one that was registered (sha256 {got[:12]}…, the registry "
            f"has {sha256[:12]}…); restore it from a backup, or promote the model again"
        )
    return folder


def load(folder: Path) -> StoredModel:
    """Read a stored model from its folder, or from the folder of the MLflow model around it.

    Raises:
        InputError: no model there, a file damaged or other than it was stored, or a model of another version.
    """
    inner = inner_folder(folder)
    try:
        document = from_json((inner / "model.json").read_text(encoding="utf-8"))
        _check_document(document, folder)
        _check_hashes(document.get("sha256"), inner, folder)
        machine_yaml = (inner / "machine.yml").read_text(encoding="utf-8")
        with np.load(inner / "arrays.npz", allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
    except (OSError, ValueError, BadZipFile, EOFError) as error:  # also text that is none
        reason = " ".join(str(error).split())
        raise InputError(
            f"model folder {folder}: not a stored model ({reason}); expected the files {', '.join(FILES)}"
        ) from None
    machine = parse_machine(machine_yaml, str(inner / "machine.yml"))
    try:
        return _from_document(_from_json(document, arrays), machine)
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"model folder {folder}: model.json is damaged ({type(error).__name__}: {error}); {_AGAIN}"
        ) from None


def inner_folder(folder: Path) -> Path:
    """Where the files of a stored model are: the folder itself, or that of the MLflow model around it."""
    return folder / "artifacts" if (folder / "artifacts" / "model.json").exists() else folder


def _check_document(document: Any, folder: Path) -> None:
    if not isinstance(document, dict) or document.get("schema") not in _READABLE:
        got = document.get("schema") if isinstance(document, dict) else type(document).__name__
        raise InputError(f"model folder {folder}: got schema {got!r}, expected {SCHEMA!r}; train the model again")


def _check_hashes(noted: Any, inner: Path, folder: Path) -> None:
    """Refuse files other than those that were stored. Those that only serve may be absent: here nothing is served."""
    for name in (*FILES[1:], *SERVED, CODE):
        where = (folder if name == CODE else inner) / name
        unnoted = name == CODE and isinstance(noted, dict) and CODE not in noted  # of an earlier program
        if name not in FILES and (unnoted or not where.exists()):
            continue
        expected = str(noted.get(name, "")) if isinstance(noted, dict) else ""
        got = hashlib.sha256(where.read_bytes()).hexdigest()
        if got != expected:
            raise InputError(
                f"model folder {folder}: not a stored model as it was promoted ({name} has sha256 {got[:12]}…, "
                f"model.json names {f'{expected[:12]}…' if expected else 'none'}); {_AGAIN}"
            )


def _from_document(plain: dict[str, Any], machine: Machine) -> StoredModel:
    bound = RunBound.from_plain(plain["bound"]) if plain.get("bound") else None
    siblings = tuple(family_from_plain(s) for s in plain.get("siblings", ()))
    region = Region.from_plain(plain["region"])
    updater = Updater.from_plain(plain["updater"]) if plain.get("updater") else None
    substitutes = Substitutes.from_plain(plain["substitutes"]) if plain.get("substitutes") else None
    family = family_from_plain(plain)
    return StoredModel(family, machine, region, plain["info"], bound, siblings, updater, substitutes)


def frame_to_batch(model: StoredModel, table: pd.DataFrame, batch_id: str = "frame") -> Batch:
    """A batch from a plain table: time_s (regular) and channels by name, in the machine file's canonical units.

    Raises:
        InputError: no time_s, or an irregular one.
    """
    if "time_s" not in table:
        raise InputError(f"table of {batch_id}: no column 'time_s'; give the time from the start in s")
    time_s = table["time_s"].to_numpy(float)
    step = np.diff(time_s)
    if len(step) and not (step[0] > 0 and np.allclose(step, step[0], rtol=0.01)):
        raise InputError(
            f"table of {batch_id}: 'time_s' is not a regular grid (steps {np.nanmin(step):g} to {np.nanmax(step):g} s);"
            " bring it to one step, or give the file itself to `thermodrift predict`"
        )
    channels = {n: c for n, c in model.machine.batch_channels().items() if n in table}
    columns = table[["time_s", *channels]].astype(float).reset_index(drop=True)
    return Batch(model.machine.machine, batch_id, columns, channels)


def predict_frame(model: StoredModel, table: pd.DataFrame) -> pd.DataFrame:
    """Predictions for a plain table, in its row order: predicted_um, outside_region.

    A column batch_id cuts the table into batches; each starts at zero.
    """
    groups = [("frame", np.arange(len(table)))]
    if "batch_id" in table and table["batch_id"].notna().any():
        groups = [(str(k), np.asarray(v)) for k, v in table.groupby("batch_id", sort=False).indices.items()]
    predicted, outside = np.full(len(table), np.nan), np.zeros(len(table), bool)
    for batch_id, rows in groups:
        batch = frame_to_batch(model, table.iloc[rows], batch_id)
        predicted[rows] = model.predict(batch)
        outside[rows] = [bool(names) for names in model.outside(batch)] | np.isnan(predicted[rows])
    return pd.DataFrame({"predicted_um": predicted, "outside_region": outside}, index=table.index)


def _to_json(value: Any, arrays: dict[str, NDArray[Any]]) -> Any:
    if isinstance(value, np.ndarray):
        if value.dtype == object:
            raise TypeError("an array of objects is not plain data")
        name = f"a{len(arrays)}"
        arrays[name] = value
        return {"$array": name}
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return {"$float": str(value)}
    if isinstance(value, Mapping):
        return {str(k): _to_json(v, arrays) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_to_json(v, arrays) for v in value]
    if value is None or isinstance(value, str | int | float | bool):
        return value
    raise TypeError(f"{type(value).__name__} is not plain data; fitted takes numbers, strings, lists and arrays")


def _from_json(value: Any, arrays: Mapping[str, NDArray[Any]]) -> Any:
    if isinstance(value, dict):
        if set(value) == {"$array"}:
            return arrays[value["$array"]]
        if set(value) == {"$float"}:
            return float(value["$float"])
        return {k: _from_json(v, arrays) for k, v in value.items()}
    return [_from_json(v, arrays) for v in value] if isinstance(value, list) else value
