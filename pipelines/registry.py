"""The registry side of promotion: versions, the aliases champion and challenger, roll-back and the state of things."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import pandas as pd
import yaml
from filelock import FileLock
from mlflow.entities.model_registry import ModelVersion
from mlflow.exceptions import MlflowException
from mlflow.protos.databricks_pb2 import RESOURCE_DOES_NOT_EXIST, ErrorCode
from mlflow.tracking import MlflowClient

from data.batch import Batch
from data.errors import InputError, closest
from features.rises import zeroed_error_um
from models.base import Family
from models.metrics import residual_std_um
from models.promotion import Choice, Comparison, compare_paired, left_out
from models.result import GridResult
from models.trust import Region, Rise
from pipelines import model_store
from pipelines.model_log import local_folder, log_version
from pipelines.settings import Settings
from pipelines.tracking import load_training, open_store, record_promotion, store_errors

CHAMPION, CHALLENGER = "champion", "challenger"
Outcome = Literal["champion", "challenger", "unchanged"]


@dataclass(frozen=True)
class Promotion:
    """What became of a training's best cell. `version` holds its model; `champion_version` runs on the machine now.

    `against` is the version that it was compared with, `obstacle` why that could not be done; `caution` and the nested
    score are the choice's (see `promotion.Choice`).
    """

    outcome: Outcome
    name: str
    version: int
    champion_version: int
    cell: str
    caution: str
    words: str
    comparison: Comparison | None = None
    against: int | None = None
    obstacle: str = ""
    forced: bool = False
    nested_S_mean_um: float = float("nan")
    nested_S_std_um: float = float("nan")

    @property
    def trusted(self) -> bool:
        return not self.caution

    @property
    def model_uri(self) -> str:
        return f"models:/{self.name}/{self.version}"

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


def promote(
    result: GridResult,
    choice: Choice,
    family: Family,
    machine_yaml: str,
    training_id: str,
    settings: Settings,
    region: Region,
    batches: Sequence[Batch] = (),
    *,
    force: bool = False,
) -> Promotion:
    """Register the refitted model of the chosen cell and decide whether it becomes the champion.

    The newcomer replaces a champion only if `promotion.compare_paired` finds it better on the same batches: the
    left-out S of both on the batches that both trainings share, and, where `batches` are given, the champion's own
    prediction on batches that it has not seen against the newcomer's left-out one. The same data, cell and machine
    file again make no new version.

    Args:
        family: the cell refitted on all batches.
        machine_yaml: text of the machine file; it travels with the model.
        region: where it was trained.
        batches: the training's batches (optional).
        force: make it the champion whatever the comparison says; the reason says so.

    Raises:
        WorkError: the store does not answer.
    """
    name = settings.model(result.machine, result.target)
    fingerprint = _fingerprint(result, choice, machine_yaml)
    (settings.home / "locks").mkdir(parents=True, exist_ok=True)
    client = open_store(settings)
    with FileLock(settings.home / "locks" / f"{name}.lock"), store_errors(settings):
        champion = _by_alias(client, name, CHAMPION)
        same = [v for v in _versions(client, name) if v.tags.get("fingerprint") == fingerprint and "outcome" in v.tags]
        if same and (champion is not None or force):
            version = same[0].version
            words = f"{name}: same batches, cell and machine file as version {version}; nothing new registered"
            if force and (champion is None or champion.version != version):
                if champion is not None:
                    client.set_model_version_tag(name, version, "replaces", champion.version)
                _crown(client, name, version, champion)
                words += f"; version {version} is champion by force"
            stays = version if champion is None or force else champion.version
            done = Promotion("unchanged", name, int(version), int(stays), choice.cell, choice.caution, words,
                             nested_S_mean_um=choice.nested_S_mean_um,
                             nested_S_std_um=choice.nested_S_std_um)  # fmt: skip
            record_promotion(client, training_id, done.as_dict())
            return done
        comparison, obstacle, why = None, "", "first model of this machine and channel"
        if champion is not None:
            comparison, obstacle, why = _against(champion, result, choice, settings, batches)
        replaces = champion is None or force or (comparison is not None and comparison.better)
        if force and champion is not None:
            why = f"by force; {why}"
        info = {
            "training_id": training_id, "cell": choice.cell, "n_batches": len(result.batches),
            "simulated": result.simulated, "score_um": choice.score_um, "choice": choice.words,
            "trained_at": pd.Timestamp.now("UTC").isoformat(timespec="seconds"), "trusted": choice.trusted,
            "caution": choice.caution,
        }  # fmt: skip
        tags = {k: _text(v) for k, v in info.items() if k != "choice"} | {
            "fingerprint": fingerprint, "machine": result.machine, "target": result.target, "reason": why,
            "selector": choice.selector, "family": choice.family, "n_tsp": str(choice.n_tsp),
            "inputs": "|".join(choice.inputs), "S_mean_um": _text(choice.S_mean_um), "S_std_um": _text(choice.S_std_um),
            **({"replaces": champion.version} if champion is not None and replaces else {}),
        }  # fmt: skip
        rise = Rise.of_cell(result.distances, choice.cell)
        new = log_version(client, name, family, machine_yaml, region, rise, info, tags, training_id)
        client.update_model_version(name, new, ("SIMULATED. " if result.simulated else "") + choice.words)
        client.set_registered_model_tag(name, "simulated", _text(result.simulated))
        if replaces:
            _crown(client, name, new, champion)
            outcome: Outcome = "champion"
        else:
            client.set_registered_model_alias(name, CHALLENGER, new)
            outcome = "challenger"
        client.set_model_version_tag(name, new, "outcome", outcome)  # last: what lacks it was interrupted
        stays = new if replaces or champion is None else champion.version
        words = f"{name} version {new} is {outcome}: {why}; {choice.words}"
        against = int(champion.version) if champion is not None else None
        done = Promotion(outcome, name, int(new), int(stays), choice.cell, choice.caution, words, comparison, against,
                         obstacle, force, choice.nested_S_mean_um, choice.nested_S_std_um)  # fmt: skip
        record_promotion(client, training_id, done.as_dict())
        return done


def rollback(name: str, settings: Settings) -> Promotion:
    """Give the alias champion back to the version that the present champion replaced.

    Raises:
        InputError: unknown model, no champion, or nothing that it replaced.
    """
    client = open_store(settings)
    (settings.home / "locks").mkdir(parents=True, exist_ok=True)
    with FileLock(settings.home / "locks" / f"{name}.lock"), store_errors(settings):
        present = find_version(client, name, CHAMPION)
        previous = present.tags.get("replaces")
        if not previous:
            raise InputError(f"model {name!r}: champion version {present.version} replaced none; nothing to go back to")
        back = find_version(client, name, previous)
        client.set_registered_model_alias(name, CHAMPION, back.version)
        client.set_model_version_tag(name, present.version, "was_champion_until", _now())
        client.set_model_version_tag(name, present.version, "rolled_back", "true")
        client.delete_model_version_tag(name, back.version, "was_champion_until")
    words = f"{name}: champion is version {back.version} again; version {present.version} was rolled back"
    return Promotion("champion", name, int(back.version), int(back.version), back.tags.get("cell", ""),
                     back.tags.get("caution", ""), words)  # fmt: skip


def status(settings: Settings) -> pd.DataFrame:
    """Every version of every model: name, version, aliases, cell, score_um, n_batches, trained_at, simulated, trusted,
    reason, was_champion_until, training_id; newest version first within a name."""
    client = open_store(settings)
    columns = ["name", "version", "aliases", "machine", "target", "cell", "score_um", "n_batches", "trained_at",
               "simulated", "trusted", "reason", "was_champion_until", "training_id"]  # fmt: skip
    rows = []
    with store_errors(settings):
        for model in client.search_registered_models(max_results=1000):
            for v in _versions(client, model.name):
                tags = v.tags
                aliases = sorted(a for a, number in model.aliases.items() if str(number) == str(v.version))
                rows.append({
                    **{c: tags.get(c, "") for c in columns}, "name": model.name, "version": int(v.version),
                    "aliases": ", ".join(aliases), "score_um": float(tags.get("score_um", "nan")),
                    "n_batches": int(tags.get("n_batches", 0)), "simulated": tags.get("simulated") == "true",
                    "trusted": tags.get("trusted") != "false",
                })  # fmt: skip
    table = pd.DataFrame(rows, columns=columns)
    return table.sort_values(["name", "version"], ascending=[True, False]).reset_index(drop=True)


def find_version(client: MlflowClient, name: str, which: str) -> ModelVersion:
    """A version by number or alias.

    Raises:
        InputError: unknown name, version or alias, with the closest and the allowed ones.
    """
    try:
        model = client.get_registered_model(name)
    except MlflowException as error:
        if error.error_code != ErrorCode.Name(RESOURCE_DOES_NOT_EXIST):
            raise
        names = [m.name for m in client.search_registered_models(max_results=1000)]
        hint = closest(name, names) if names else "the registry is empty; train first"
        raise InputError(f"unknown model {name!r}; {hint}") from None
    if which in model.aliases:
        return client.get_model_version_by_alias(name, which)
    versions = {str(v.version): v for v in _versions(client, name)}
    if which not in versions:
        kind = "version" if which.isdigit() else "alias"
        raise InputError(f"model {name!r} has no {kind} {which!r}; {closest(which, [*model.aliases, *versions])}")
    return versions[which]


def _against(
    champion: ModelVersion, result: GridResult, choice: Choice, settings: Settings, batches: Sequence[Batch]
) -> tuple[Comparison | None, str, str]:
    """The paired comparison with a champion, what stood in its way (None, why), and the reason in words."""
    tags = champion.tags
    try:
        then = load_training(tags.get("training_id", ""), settings).result
    except InputError as error:
        why = f"the champion (version {champion.version}) cannot be compared ({error}); it stays"
        return None, str(error), why
    new = left_out(result, choice.protocol, choice.selector, choice.family, choice.n_tsp)
    old = left_out(then, choice.protocol, tags["selector"], tags["family"], int(tags["n_tsp"]))
    known = set(then.batches["batch_id"])
    unseen = [b for b in batches if b.batch_id not in known]
    if unseen and choice.protocol != "train-on-one":
        old = pd.concat([old, _score_unseen(champion, unseen, choice, result, settings)], ignore_index=True)
    comparison = compare_paired(new, old, settings.promotion)
    fresh = f" ({len(unseen)} of them new to the champion)" if unseen else ""
    return comparison, "", f"against version {champion.version}: {comparison.words}{fresh}"


def _score_unseen(
    champion: ModelVersion, unseen: Sequence[Batch], choice: Choice, result: GridResult, settings: Settings
) -> pd.DataFrame:
    """S of the champion's own predictions on batches it was not trained on: batch_id, digest, S_um."""
    model = model_store.load(Path(local_folder(champion.source, settings)))
    rows = []
    for b in unseen:
        try:
            error_um = zeroed_error_um(b, result.target) - model.predict(b)
        except InputError:  # an input of the champion is no longer recorded: no comparison on this batch
            continue
        rows.append({"batch_id": b.batch_id, "digest": str(b.digest), "S_um": residual_std_um(error_um)})
    return pd.DataFrame(rows, columns=["batch_id", "digest", "S_um"])


def _crown(client: MlflowClient, name: str, new: str, previous: ModelVersion | None) -> None:
    client.set_registered_model_alias(name, CHAMPION, new)
    if previous is not None:
        client.set_model_version_tag(name, previous.version, "was_champion_until", _now())
    if CHALLENGER in client.get_registered_model(name).aliases:  # it lost to an older champion
        client.delete_registered_model_alias(name, CHALLENGER)


def _fingerprint(result: GridResult, choice: Choice, machine_yaml: str) -> str:
    """Same batches (id and content), same cell, same meaning of the machine file: same fingerprint."""
    seen = sorted((str(b), str(d)) for b, d in zip(result.batches["batch_id"], result.batches["digest"], strict=True))
    content = json.dumps([seen, choice.protocol, choice.cell, list(choice.inputs), yaml.safe_load(machine_yaml)],
                         sort_keys=True, default=str)  # fmt: skip
    return hashlib.sha256(content.encode()).hexdigest()


def _versions(client: MlflowClient, name: str) -> list[ModelVersion]:
    quoted = name.replace("'", "''")
    found = client.search_model_versions(f"name = '{quoted}'", max_results=10_000)
    return sorted(found, key=lambda v: -int(v.version))


def _by_alias(client: MlflowClient, name: str, alias: str) -> ModelVersion | None:
    try:
        return client.get_model_version_by_alias(name, alias)
    except MlflowException as error:
        if error.error_code in ("RESOURCE_DOES_NOT_EXIST", "INVALID_PARAMETER_VALUE"):
            return None
        raise


def _now() -> str:
    return pd.Timestamp.now("UTC").isoformat(timespec="seconds")


def _text(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)
