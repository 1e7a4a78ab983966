"""The state of every machine and error channel: champion, drift of inputs and error, failed sensors.

It takes seconds per machine to gather: models and runs are loaded. It is kept per machine (`fleet_state`), with what it
was made from, and gathered again only for machines whose champions or batches have changed; `refresh` does so at the
end of a training or ingest. All of it together with the tables of `thermodrift status` is in one file, which `warm`
reads without any heavy import, as long as the files behind it are unchanged.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import secrets
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from data.errors import InputError, WorkError
from data.files import write_atomic
from pipelines.caller import Say
from pipelines.fleet import fleet_state
from pipelines.home import home
from pipelines.store import lookups

if TYPE_CHECKING:
    from data.batch import Batch
    from data.lake import Lake
    from pipelines.settings import Settings
    from pipelines.store.model_store import StoredModel

SCHEMA = "thermodrift.status/4"
KEPT_RUNS = 20  # of each channel, the newest
KEPT_TRAININGS = 100  # the newest
_STATUS = "status.json"
_VARIABLES = ("THERMODRIFT_HOME", "THERMODRIFT_LAKE")  # and those that the settings file names
_NAMED = re.compile(r"\{env:([^{}]+)\}")


@dataclass(frozen=True)
class Champion:
    """A champion as the registry has it; `version` None: the model has none, then `provisional` may stand in for it,
    whose `source` and `tags` these are."""

    name: str
    target: str
    version: int | None
    since: str
    source: str
    tags: Mapping[str, str]
    provisional: int | None = None

    @property
    def mark(self) -> list[Any]:
        """What the state of its channel depends on."""
        return [self.name, self.version, self.source, self.provisional]


def warm() -> dict[str, Any] | None:
    """The kept status, None where something behind it has changed, or is on a server and may have."""
    kept = _kept()
    if not kept or kept["made_from"] is None:
        return None
    before = kept["made_from"]
    return kept if before == _stats(map(Path, before["files"]), before["salt"]) else None


def kept_channels() -> list[dict[str, Any]]:
    """The states of all channels as they were last gathered, whether or not they are warm."""
    found: list[dict[str, Any]] = _kept().get("channels", [])
    return found


def _kept() -> dict[str, Any]:
    kept = fleet_state.read_file(home() / "fleet" / _STATUS)
    return kept if kept.get("schema") == SCHEMA else {}


def refresh(settings: Settings, say: Say = lambda text: None) -> dict[str, Any]:
    """Gather what has changed, and keep it; the whole status.

    Returns:
        `models` (versions with an alias and the newest ones), `trainings` (the newest `KEPT_TRAININGS`), `diagnoses`:
        rows of the tables of `thermodrift status`; `lake`: batches and quarantined
        files by machine; `channels`: the state of every machine and channel, see `_channel`; `as_of` (UTC).

    Raises:
        WorkError: the store or the lake does not answer.
    """
    from pipelines.console import records
    from pipelines.jobs.recordings import home_lake
    from pipelines.store import registry, tracking

    lake = home_lake()
    tracking.open_store(settings, say)  # the first use takes seconds
    before = _made_from(settings, lake)
    tables = {
        "models": registry.status(settings, history=False),
        "trainings": tracking.trainings(settings=settings, newest=KEPT_TRAININGS),
        "diagnoses": tracking.diagnoses(settings=settings),
    }
    champions = _champions(settings)
    held = {m: {"batches": len(lake.batch_ids(m)), "quarantined": len(lake.quarantined(m))} for m in lake.machines()}
    channels = []
    for machine in sorted({*champions, *held}):
        channels += _machine(settings, lake, machine, champions.get(machine, []), say)
    status = {
        "schema": SCHEMA, "as_of": datetime.now(UTC).isoformat(timespec="seconds"), "home": str(settings.home),
        "made_from": before, **{k: records(t) for k, t in tables.items()}, "lake": held, "channels": channels,
    }  # fmt: skip
    with suppress(OSError):  # a home that cannot be written is gathered anew each time
        write_atomic(
            fleet_state.folder_of(settings.home) / _STATUS, json.dumps(status, ensure_ascii=False, default=str),
            private=True,
        )  # fmt: skip
    return status


def _champions(settings: Settings) -> dict[str, list[Champion]]:
    """Champions by machine."""
    from pipelines.store import audit
    from pipelines.store.runs import registered_models
    from pipelines.store.tracking import open_store, store_errors

    client, found = open_store(settings), dict[str, list[Champion]]()
    with store_errors(settings):
        for model in registered_models(client):
            log = audit.read(model)
            if not log.machine or not log.target:
                continue
            version, since, source, tags = log.champion, "", "", dict[str, str]()
            if (stands := version or log.provisional) is not None:
                v = client.get_model_version(model.name, str(stands))
                source, tags = str(v.source), dict(v.tags)
            if version is not None:
                reigns = [r for r in log.reigns if r.until is None]
                since = reigns[-1].since.isoformat(timespec="seconds") if reigns else tags.get("trained_at", "")
            champion = Champion(model.name, log.target, version, since, source, tags, log.provisional)
            found.setdefault(log.machine, []).append(champion)
    return found


def _machine(
    settings: Settings, lake: Lake, machine: str, champions: Sequence[Champion], say: Say
) -> list[dict[str, Any]]:
    """The states of a machine's channels, as kept where nothing has changed."""
    current = {i: v[-1] for i, v in (lake.contents(machine) if machine in lake.machines() else {}).items()}
    mark = [SCHEMA, [c.mark for c in champions], sorted([i, v.digest, *v.files] for i, v in current.items())]
    kept = fleet_state.read(settings.home, machine, "state")
    if kept.get("made_from") == json.loads(json.dumps(mark)):
        found: list[dict[str, Any]] = kept["channels"]
        return found
    say(f"state of {machine}")
    found = _gathered(settings, lake, machine, champions, bool(current))
    with suppress(OSError):
        fleet_state.write(settings.home, machine, "state", {"made_from": mark, "channels": found})
    return found


def _gathered(
    settings: Settings, lake: Lake, machine: str, champions: Sequence[Champion], recorded: bool
) -> list[dict[str, Any]]:
    from pipelines.jobs.recordings import load_batches
    from pipelines.store import model_store, registry

    models: dict[str, StoredModel] = {}
    trouble: dict[str, str] = {}
    for c in champions:
        try:
            if c.source:
                folder = registry.version_folder(c.source, c.tags, settings)
                models[c.target] = model_store.load(folder)
        except (InputError, WorkError) as error:
            trouble[c.target] = str(error)
    batches: list[Batch] = []
    try:
        if recorded:
            described = next((m.machine for m in models.values()), None)
            batches = load_batches(lake, described) if described is not None else lake.load_all(machine)
    except (InputError, WorkError) as error:
        trouble |= {c.target: str(error) for c in champions}
    targets = [c.target for c in champions]
    unlearned = [t for t in dict.fromkeys(t for b in batches for t in b.names("error")) if t not in targets]
    out = []
    for c in [*champions, *(Champion("", t, None, "", "", {}) for t in unlearned)]:
        out.append(_channel(settings, machine, c, models.get(c.target), batches, trouble.get(c.target, "")))
    return out


def _channel(
    settings: Settings, machine: str, c: Champion, model: StoredModel | None, batches: Sequence[Batch], trouble: str
) -> dict[str, Any]:
    """A channel: machine, channel, model, version (of the champion), provisional; of the champion, or the provisional
    version that stands in for it: cell, since (as champion), trained_at, reason, the error to expect; `seen`: runs that
    it was trained on, with the last one's start; `runs`: the newest runs in the lake, oldest first, with their distance
    from the trained region in widths and, where they are newer than the training, the model's S; `sensors`: channels
    without usable values in them; `unknown`: why something could not be found out."""
    from pipelines.store.tracking import load_training

    ids, starts = set[str](), list[str]()
    if c.source:
        try:
            table = load_training(c.tags.get("training_id", ""), settings).result.batches
            ids, starts = set(table["batch_id"].astype(str)), sorted(s for s in table["start"].map(_date) if s)
        except (InputError, WorkError) as error:
            trouble = trouble or str(error)
    last_seen = starts[-1] if starts else ""
    runs = [_run(b, c, model, ids, last_seen) for b in batches[-KEPT_RUNS:]]
    return {
        "machine": machine, "channel": c.target, "model": c.name, "version": c.version, "provisional": c.provisional,
        "cell": c.tags.get("cell", ""), "family": c.tags.get("family", ""), "since": c.since,
        "trained_at": c.tags.get("trained_at", ""), "reason": c.tags.get("reason", ""),
        "simulated": any(b.simulated for b in batches) or c.tags.get("simulated") == "true",
        "expected_S_um": _number(c.tags.get("expected_S_um")),
        "bound90_S_um": _number(c.tags.get("expected_S_bound90_um")),
        "expected_by": c.tags.get("expected_by", ""), "n_seen": len(ids), "last_seen": last_seen, "runs": runs,
        "sensors": [s for b in batches[-KEPT_RUNS:] for s in _failed(b, model)], "unknown": trouble,
    }  # fmt: skip


def _run(batch: Batch, c: Champion, model: StoredModel | None, ids: set[str], last_seen: str) -> dict[str, Any]:
    """One run: how far outside, and the error of the champion where it is newer than the training."""
    from models.selection.trust import SLACK, farthest, watched

    start = _date(batch.start)
    newer = bool(ids) and batch.batch_id not in ids and (not start or not last_seen or start > last_seen)
    out: dict[str, Any] = {"batch_id": batch.batch_id, "start": start, "newer": newer, "distance": None,
                           "outside": False, "why": "", "S_um": None}  # fmt: skip
    if model is None:
        return out
    values = watched(batch, model.family.inputs)
    beyond = model.region.beyond(values)
    if beyond:
        distance, quantity = farthest(beyond)
        out["distance"], out["outside"] = distance, distance > SLACK
        out["why"] = model.region.excess(quantity, values) if distance > SLACK else ""
    if newer:
        out["S_um"] = _S_um(batch, model, c.target)
    return out


def _S_um(batch: Batch, model: StoredModel, target: str) -> float | None:
    from features.rises import zeroed_error_um
    from models.metrics import residual_std_um

    try:
        return _number(residual_std_um(zeroed_error_um(batch, target) - model.predict(batch)))
    except InputError:  # an input or the error is not recorded
        return None


def _failed(batch: Batch, model: StoredModel | None) -> list[dict[str, Any]]:
    """Channels that lack more than a fifth of a run's values, for a reason of their own."""
    import numpy as np

    from data.checks import MOST_MASKED

    inputs = {i.partition("@")[0] for i in model.family.inputs} if model is not None else set()
    out = []
    for name in batch.names("temperature", "ambient", "driver", "error"):
        checks = sorted({f.check for f in batch.findings if f.channel == name and f.masks and not f.overruled})
        values = batch.masked(name) if name in batch.table else np.full(batch.n_rows, np.nan)
        lacking = float(np.mean(~np.isfinite(values))) if batch.n_rows else 0.0
        if checks and lacking > MOST_MASKED:
            out.append({"batch_id": batch.batch_id, "start": _date(batch.start), "channel": name, "checks": checks,
                        "share": round(lacking, 3), "input": name in inputs})  # fmt: skip
    return out


def _date(start: Any) -> str:
    """ISO date and time; empty where it is not known."""
    import pandas as pd

    when = pd.to_datetime(start, errors="coerce")
    return "" if pd.isna(when) else str(when.isoformat(timespec="seconds"))


def _number(value: Any) -> float | None:
    import math

    try:
        number = float(value)
    except (TypeError, ValueError):
        return None
    return number if math.isfinite(number) else None


def _made_from(settings: Settings, lake: Lake) -> dict[str, Any] | None:
    """The files that decide the status; None where the store or the lake is elsewhere."""
    store, root = settings.store_file, getattr(lake, "root", None)
    if store is None or not isinstance(root, Path):
        return None
    logs = [root / "_quarantine", *sorted(root.glob("_quarantine/*/reasons.jsonl"))]
    return _stats([*lookups.store_files(store), root / "_manifest.json", *logs], secrets.token_hex())


def _stats(files: Iterable[Path], salt: str) -> dict[str, Any]:
    """Size and time of change of files, None where one is not there; and a digest of the settings file of the working
    directory, and of the variables that decide where store and lake are, salted since some are secrets.
    MLFLOW_TRACKING_URI is none of them: MLflow itself sets it."""
    settings = Path("mlflow.yml").resolve()
    own = settings.read_text(encoding="utf-8", errors="replace") if settings.exists() else ""
    named = {v: os.environ.get(v, "") for v in (*_VARIABLES, *_NAMED.findall(own))}
    digest = hashlib.scrypt(json.dumps([own, named]).encode(), salt=salt.encode(), n=2**10, r=8, p=1).hex()
    return {"files": lookups.stats(files), "salt": salt, "settings": digest}
