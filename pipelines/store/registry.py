"""The model registry: versions in MLflow, promotion, aliases (champion, provisional, challenger), roll-back, status."""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import cached_property
from importlib.metadata import PackageNotFoundError, requires
from importlib.metadata import version as installed
from pathlib import Path
from typing import Any, Literal, get_args

import mlflow
import pandas as pd
import yaml
from filelock import FileLock
from mlflow.entities import LoggedModelOutput, LoggedModelStatus, Metric
from mlflow.entities.model_registry import ModelVersion, RegisteredModel
from mlflow.exceptions import MlflowException
from mlflow.models import ModelSignature
from mlflow.protos.databricks_pb2 import RESOURCE_DOES_NOT_EXIST, ErrorCode
from mlflow.tracking import MlflowClient
from mlflow.types import ColSpec, Schema
from mlflow.types.schema import AnyType

from compensation.faults import FaultCost
from compensation.substitutes import Substitutes
from data.batch import Batch
from data.errors import InputError, closest, one_of
from features.rises import zeroed_error_um
from models.base import Family
from models.metrics import residual_std_um
from models.protocols import PromotionRule
from models.selection.conformal import RunBound
from models.selection.outlook import Outlook, outlook
from models.selection.promotion import Choice, Comparison, compare_paired, left_out
from models.selection.result import GridResult
from models.selection.trust import Region
from pipelines.settings import Settings
from pipelines.store import audit, database, fitted_model, lookups, model_store
from pipelines.store.audit import CHAMPION, PROVISIONAL
from pipelines.store.runs import (
    close_interrupted,
    code_version,
    mark_champion,
    model_versions,
    registered_models,
    standing_versions,
    versions_by_model,
)
from pipelines.store.tracking import load_training, open_store, record_promotion, store_errors

_MODEL_PACKAGES = ("mlflow", "numpy", "pandas", "scipy", "scikit-learn", "pydantic", "PyYAML")
_SERVED_PACKAGES = ("mlflow", "numpy", "pandas", "onnxruntime")  # of a family that is an ONNX file
Outcome = Literal["champion", "provisional", "challenger", "unchanged"]
_NUMBER = AnyType()  # MLflow refuses whole numbers, as pandas reads them from a file, where a double is expected

OUTCOME = "outcome"  # the last tag of a version; what lacks it was interrupted
_INTERRUPTED = "its promotion was interrupted; `thermodrift promote` or the next training finishes it"


@dataclass(frozen=True)
class Promotion:
    """The outcome for a training's best cell. `version` holds its model; `champion_version` is the champion now, None
    where no model is trustworthy. `outlook` is the error to expect in the next season.

    `against` is the version that it was compared with, `obstacle` the reason why no comparison was possible; `caution`,
    `standing`, `authority` and the nested score are the choice's (see `promotion.Choice`).
    """

    outcome: Outcome
    name: str
    version: int
    champion_version: int | None
    cell: str
    caution: str
    summary: str
    comparison: Comparison | None = None
    against: int | None = None
    obstacle: str = ""
    forced: bool = False
    nested_S_mean_um: float = float("nan")
    nested_S_std_um: float = float("nan")
    outlook: Outlook | None = None
    standing: str = "champion"
    authority: float = 1.0
    faults: str = ""  # what failing sensors cost, one sentence; empty where it is not known

    @property
    def trusted(self) -> bool:
        return not self.caution

    @property
    def model_uri(self) -> str:
        return f"models:/{self.name}/{self.version}"

    def as_dict(self) -> dict[str, Any]:
        kept = asdict(self)
        own = {k: v.as_dict() for k in ("comparison", "outlook") if (v := getattr(self, k)) is not None}
        return {**kept, **own, "words": kept.pop("summary")}


@dataclass(frozen=True)
class Newcomer:
    """A chosen cell, refitted on all batches of its training.

    Args:
        machine_yaml: text of the machine file; it is stored with the model.
        region: where the model was trained.
        batches: the training's batches; with them the champion is also compared on those that it has not seen.
    """

    result: GridResult
    choice: Choice
    family: Family
    machine_yaml: str
    training_id: str
    region: Region
    batches: Sequence[Batch] = ()

    @property
    def outlook(self) -> Outlook:
        return outlook(self.result, self.choice)

    @cached_property
    def substitutes(self) -> Substitutes | None:
        return fitted_model.guarded(self.family, self.batches)

    @cached_property
    def faults(self) -> FaultCost | None:
        return fitted_model.faults_of(self.family, self.batches, self.substitutes)

    @property
    def fingerprint(self) -> str:
        """Same batches (id and content), same cell, same meaning of the machine file: same fingerprint."""
        table, choice = self.result.batches, self.choice
        seen = sorted((str(b), str(d)) for b, d in zip(table["batch_id"], table["digest"], strict=True))
        cell: list[Any] = [choice.protocol, choice.cell, list(choice.inputs)]
        if choice.standing == PROVISIONAL:  # a version that another rule has refused stays refused
            cell += [PROVISIONAL, choice.authority]
        content = json.dumps([seen, *cell, yaml.load(self.machine_yaml, yaml.CSafeLoader)], sort_keys=True, default=str)
        return hashlib.sha256(content.encode()).hexdigest()


def promote(new: Newcomer, settings: Settings, *, force: bool = False) -> Promotion:
    """Register the refitted model of the chosen cell and decide whether it becomes the champion.

    The newcomer replaces a champion only if `promotion.compare_paired` finds it better on the same batches: the
    left-out S of both on the batches that both trainings share, and, where `Newcomer.batches` are given, the
    champion's own prediction on batches that it has not seen against the newcomer's left-out one. A choice that is not
    trustworthy becomes no champion. The same data, cell and machine file again make no new version.

    Args:
        force: make it the champion whatever the comparison says; the reason says so.

    Raises:
        WorkError: the store does not answer.
    """
    name = settings.model(new.result.machine, new.result.target)
    client = open_store(settings)
    with _locked(name, settings):
        close_interrupted(client)
        champion, fingerprint = _by_alias(client, name, CHAMPION), new.fingerprint
        same = [v for v in model_versions(client, name) if v.tags.get("fingerprint") == fingerprint]
        begun = next((v for v in same if _is_unfinished(client, v, new.training_id)), None)
        done = [v for v in same if OUTCOME in v.tags]
        if begun is None and done and (champion is not None or force or new.choice.standing != CHAMPION):
            outcome = _keep(client, done[0], champion, new, force)
            known = done[0].tags.get("training_id") == new.training_id and not force  # what became of it is recorded
        else:
            outcome, known = _register(client, name, champion, new, settings, force, begun), False
        if not known:
            if outcome.champion_version == outcome.version:
                mark_champion(client, new.training_id, str(outcome.version))
            record_promotion(client, new.training_id, outcome.as_dict())
        return outcome


def _is_unfinished(client: MlflowClient, version: ModelVersion, training_id: str) -> bool:
    """Whether the promotion that made a version was interrupted: before its outcome, or before its training has it."""
    if OUTCOME not in version.tags:
        return True
    own = version.tags.get("training_id") == training_id
    return own and "promotion" not in client.get_run(training_id).data.tags


def _keep(
    client: MlflowClient, same: ModelVersion, champion: ModelVersion | None, new: Newcomer, force: bool
) -> Promotion:
    """No new version: one of the same fingerprint exists; by force it becomes the champion."""
    name, version, choice = same.name, same.version, new.choice
    summary = f"{name}: same batches, cell and machine file as version {version}; nothing new registered"
    if force and (champion is None or champion.version != version):
        if champion is not None:
            client.set_model_version_tag(name, version, "replaces", champion.version)
        why = f"by force; same batches, cell and machine file as version {version}"
        _crown(client, name, version, why, new.training_id, force)
        summary += f"; version {version} is champion by force"
    stays = same if force else champion
    return Promotion(
        "unchanged", name, int(version), None if stays is None else int(stays.version), choice.cell, choice.caution,
        summary, nested_S_mean_um=choice.nested_S_mean_um, nested_S_std_um=choice.nested_S_std_um, outlook=new.outlook,
        standing=choice.standing, authority=choice.authority,
    )  # fmt: skip


def _register(
    client: MlflowClient,
    name: str,
    champion: ModelVersion | None,
    new: Newcomer,
    settings: Settings,
    force: bool,
    begun: ModelVersion | None,
) -> Promotion:
    """A version, compared with the champion, as champion, challenger or, where there is none, provisional.

    In this order: the model's files, the version with all its tags, the alias, the outcome on the version, the outcome
    on the training (in `promote`). After an interruption between any two the next call goes on with the version that
    is there (`begun`): what lacks an outcome is none of them unless an alias names it.

    Args:
        champion: what the alias names now, which may be `begun` itself.
    """
    choice = new.choice
    crowned = begun is not None and champion is not None and champion.version == begun.version
    settled = begun is not None and (begun.tags.get(OUTCOME) or (CHAMPION if crowned else ""))
    if force and settled != CHAMPION:
        settled = ""
    if begun is not None and settled:  # compare with what it was compared with
        number = begun.tags.get("against", begun.tags.get("replaces", ""))
        champion = client.get_model_version(name, number) if number else None
    comparison, obstacle, why = None, "", "first champion of this machine and channel"
    if champion is not None:
        comparison, obstacle, why = _against(champion, new.result, choice, settings, new.batches)
    if choice.standing == PROVISIONAL:
        why = f"better than no model, not shown beyond doubt; it sends {100 * choice.authority:.3g} % of its correction"
    elif not choice.trusted:
        why = "no trustworthy model"
    budget_um, faults = settings.promotion.fault_budget_um, new.faults
    dear = budget_um is not None and faults is not None and faults.worst_um > budget_um
    if dear and faults is not None:
        why += f"; a fault of a sensor costs {faults.worst_um:.3g} µm ({faults.worst}), more than fault_budget_um"
    why = f"by force; {why}" if force and (champion is not None or not choice.trusted) else why
    better = champion is None or (comparison is not None and comparison.better)
    outcome: Outcome = "challenger"
    if settled:
        outcome = one_of(settled, get_args(Outcome), OUTCOME)
    elif force or (choice.standing == CHAMPION and better and not dear):
        outcome = "champion"
    elif champion is None and choice.standing == PROVISIONAL and not dear:
        outcome = "provisional"
    replaces = outcome == CHAMPION
    reason = ", ".join(filter(None, (why, choice.caution, choice.lacking)))
    against = "" if champion is None else str(champion.version)
    tags = {"reason": reason, "against": against, "replaces": against if replaces else ""}
    if begun is None:
        version = _log_version(client, name, new, tags)
    else:
        version = str(begun.version)
        for key, text in tags.items():
            client.set_model_version_tag(name, version, key, text)
    client.set_registered_model_tag(name, "simulated", _text(new.result.simulated))
    if not settled:
        if replaces:
            _crown(client, name, version, reason, new.training_id, force)
        else:
            client.set_registered_model_alias(name, outcome, version)
            if choice.standing == "refused":  # on more runs than an older provisional version was judged by
                _drop(client, name, PROVISIONAL)
    client.set_model_version_tag(name, version, OUTCOME, outcome)
    return Promotion(
        outcome, name, int(version), int(version) if replaces else None if champion is None else int(champion.version),
        choice.cell, choice.caution, f"{name} version {version} is {outcome}: {why}; {choice.summary}", comparison,
        None if champion is None else int(champion.version), obstacle, force, choice.nested_S_mean_um,
        choice.nested_S_std_um, new.outlook, choice.standing, choice.authority,
        _said(new, settings.promotion),
    )  # fmt: skip


def _said(new: Newcomer, rule: PromotionRule) -> str:
    """What failing sensors cost, and what doing without the dearest of them costs."""
    if new.faults is None:
        return ""
    spared = fitted_model.spared(new.faults, new.choice, new.result, rule, new.machine_yaml, new.batches)
    return "; ".join(filter(None, (new.faults.summary, spared)))


def _info(new: Newcomer) -> dict[str, Any]:
    """What is stored with the model: the error to expect first."""
    choice, result, expected = new.choice, new.result, new.outlook
    return {
        "expected_S_um": expected.S_um, "expected_S_bound90_um": expected.bound_um, "expected_by": expected.protocol,
        "expected_S_alone_um": expected.cell_S_um, "leave_batch_out_S_mean_um": expected.leave_batch_out_um,
        "leave_batch_out_S_std_um": expected.leave_batch_out_std_um, "expected": expected.summary,
        "training_id": new.training_id, "cell": choice.cell, "n_batches": len(result.batches),
        "simulated": result.simulated, "score_um": choice.score_um, "choice": choice.summary,
        "trained_at": audit.now().isoformat(timespec="seconds"),
        "trusted": choice.trusted, "caution": choice.caution, "standing": choice.standing,
        "authority": choice.authority, "faults": {} if new.faults is None else new.faults.as_plain(),
    }  # fmt: skip


def _tags(new: Newcomer) -> dict[str, str]:
    """Tags of the version beyond those of `_info`."""
    choice, result = new.choice, new.result
    return {
        "fingerprint": new.fingerprint, "machine": result.machine, "target": result.target,
        "selector": choice.selector, "family": choice.family, "n_tsp": str(choice.n_tsp),
        "inputs": "|".join(choice.inputs), "S_mean_um": _text(choice.S_mean_um), "S_std_um": _text(choice.S_std_um),
        "code_version": code_version(), **_fault_tags(new.faults),
    }  # fmt: skip


def _fault_tags(faults: FaultCost | None) -> dict[str, str]:
    if faults is None:
        return {}
    return {
        "faults": faults.summary, "worst_fault": faults.worst, "worst_fault_um": _text(round(faults.worst_um, 1)),
        "sensor_um_per_K": json.dumps({n: round(v, 2) for n, v in faults.um_per_K.items()}),
    }  # fmt: skip


def rollback(name: str, settings: Settings, reason: str = "", of: int | None = None) -> Promotion:
    """Make the version that was champion before the present one the champion again, by the log of champions.

    A version that was rolled back is not returned to: only a promotion makes it champion again. A roll-back that was
    interrupted is finished by the next one, which then goes no further.

    Args:
        reason: why; the log of champions keeps it.
        of: the version to roll back; where it is not the champion (any more), nothing changes.

    Raises:
        InputError: unknown model, no champion, or none before it.
        WorkError: the store does not answer.
    """
    client = open_store(settings)
    with _locked(name, settings):
        model, present = find_model(client, name), find_version(client, name, CHAMPION)
        log, champion = audit.read(model), int(present.version)
        if of is not None and of != champion:
            return _back(present, f"{name}: champion is version {champion}, not {of}; nothing changed")
        if log.unmarked and log.entries[-1].action == "rollback":
            rejected = log.entries[-1].from_version
            audit.finish(client, name, log.unmarked)
            summary = f"{name}: champion is version {champion} again; the roll-back of version {rejected} is finished"
        else:
            stack = log.stack
            below = stack[: stack.index(champion)] if champion in stack else stack
            held = {int(v.version): v for v in model_versions(client, name)}
            back = next((held[v] for v in reversed(below) if v in held), None)
            if back is None:
                raise InputError(
                    f"model {name!r}: no version was champion before version {champion} and not rolled back; nothing "
                    f"to go back to; `thermodrift promote` makes another one champion"
                )
            audit.move_champion(
                client, name, back.version, action="rollback", why=reason or f"version {champion} was rolled back",
                training_id=back.tags.get("training_id", ""), code_version=code_version(),
            )  # fmt: skip
            summary = f"{name}: champion is version {back.version} again; version {champion} was rolled back"
            present, rejected = back, champion
        client.set_model_version_tag(name, str(rejected), "rolled_back", "true")
        mark_champion(client, present.tags.get("training_id", ""), str(present.version))
        return _back(present, summary)


def _back(version: ModelVersion, summary: str) -> Promotion:
    number, tags = int(version.version), version.tags
    return Promotion("champion", version.name, number, number, tags.get("cell", ""), tags.get("caution", ""), summary,
                     standing=tags.get("standing", CHAMPION), authority=float(tags.get("authority", "1")))  # fmt: skip


def status(settings: Settings, history: bool = True) -> pd.DataFrame:
    """Every version of every model, or without `history` those that an alias names and the newest one.

    Returns:
        name, version, aliases, expected_S_um, expected_S_bound90_um and expected_by (the protocol) of a run in the next
        season, leave_batch_out_S_mean_um, cell, score_um, n_batches, trained_at, simulated, trusted, standing
        (champion, provisional or refused, by its training), reason, was_champion_until (UTC, by the log of champions;
        empty for the champion), training_id; newest version first within a name.
    """
    client = open_store(settings)
    numbers = ["expected_S_um", "expected_S_bound90_um", "leave_batch_out_S_mean_um", "score_um"]
    columns = ["name", "version", "aliases", "machine", "target", *numbers[:2], "expected_by", *numbers[2:3], "cell",
               "score_um", "n_batches", "trained_at", "simulated", "trusted", "standing", "expected", "reason",
               "was_champion_until", "training_id"]  # fmt: skip
    rows = []
    with store_errors(settings):
        every = versions_by_model(client) if history else {}
        for model in registered_models(client):
            versions = every.get(model.name, []) if history else standing_versions(client, model)
            log = audit.read(model)
            ends = {r.version: r.until for r in log.reigns if r.until and r.version != log.champion}
            for v in versions:
                tags, until = v.tags, ends.get(int(v.version))
                aliases = sorted(a for a, number in model.aliases.items() if str(number) == str(v.version))
                rows.append({
                    **{c: tags.get(c, "") for c in columns}, "name": model.name, "version": int(v.version),
                    "reason": tags.get("reason", "") if OUTCOME in tags or aliases else _INTERRUPTED,
                    "aliases": ", ".join(aliases), **{n: float(tags.get(n, "nan")) for n in numbers},
                    "n_batches": int(tags.get("n_batches", 0)), "simulated": tags.get("simulated") == "true",
                    "trusted": tags.get("trusted") != "false",
                    "standing": tags.get("standing") or ("refused" if tags.get("trusted") == "false" else CHAMPION),
                    "was_champion_until": "" if until is None else until.isoformat(timespec="seconds"),
                })  # fmt: skip
    table = pd.DataFrame(rows, columns=columns)
    return table.sort_values(["name", "version"], ascending=[True, False]).reset_index(drop=True)


def find_model(client: MlflowClient, name: str) -> RegisteredModel:
    """A registered model by name.

    Raises:
        InputError: unknown name, with the closest.
    """
    try:
        return client.get_registered_model(name)
    except MlflowException as error:
        if error.error_code != ErrorCode.Name(RESOURCE_DOES_NOT_EXIST):
            raise
        raise lookups.unknown_model(name, (m.name for m in registered_models(client))) from None


def find_version(client: MlflowClient, name: str, which: str) -> ModelVersion:
    """A version by number or alias; empty: `lookups.which_of`.

    Raises:
        InputError: unknown name, version or alias, with the closest and the allowed ones.
    """
    model = find_model(client, name)
    which = lookups.which_of(model.aliases, which)
    if which in model.aliases:
        return client.get_model_version_by_alias(name, which)
    versions = {str(v.version): v for v in model_versions(client, name)}
    if which == CHAMPION and versions:
        newest, provisional = next(iter(versions.values())), model.aliases.get(PROVISIONAL)
        usable = f"`predict` and `rehearse` take any version, such as --model models:/{name}/{newest.version}"
        if provisional:
            usable = (
                f"`predict`, `rehearse` and `export` take provisional version {provisional}: --model models:/{name}"
            )
        raise InputError(f"model {name!r} has no champion: {newest.tags.get('reason', 'none was promoted')}; {usable}")
    if which not in versions:
        kind = "version" if which.isdigit() else "alias"
        raise InputError(f"model {name!r} has no {kind} {which!r}; {closest(which, [*model.aliases, *versions])}")
    return versions[which]


def version_folder(source: str, tags: Mapping[str, str], settings: Settings) -> Path:
    """The local folder of the files of a registered version with this source and these tags, as they were registered.

    Raises:
        InputError: `model.json` is another one.
    """
    place = _place(source, tags, settings)
    return model_store.verified(Path(place.folder), place.sha256)


def _place(source: str, tags: Mapping[str, str], settings: Settings) -> lookups.Place:
    """The tag ``sha256`` is `model_store.digest`; an earlier program's version has none."""
    return lookups.Place(local_folder(source, settings), tags.get("sha256", ""))


def look_up(name: str, which: str, known: lookups.Registry, settings: Settings) -> lookups.Place:
    """Where the files of a version are; kept together with what is `known`. Raises as `find_version`."""
    client = open_store(settings)
    with store_errors(settings):
        version = find_version(client, name, which)
        aliases = _aliases(client)
    place = _place(version.source, version.tags, settings)
    lookups.keep(known, aliases, {f"{name}/{version.version}": place}, settings.home)
    return place


def remember(versions: Iterable[tuple[str, int]], settings: Settings) -> None:
    """Keep where these versions (name, number) are, so that the commands after this one find them without MLflow.

    Call it after the last write to the store: what is kept holds until the next.
    """
    known, client = lookups.kept(settings), open_store(settings)
    with store_errors(settings):
        held = [client.get_model_version(name, str(number)) for name, number in versions]
        found = {f"{v.name}/{v.version}": _place(v.source, v.tags, settings) for v in held}
        lookups.keep(known, _aliases(client), found, settings.home)


def _aliases(client: MlflowClient) -> dict[str, dict[str, str]]:
    return {m.name: {a: str(n) for a, n in m.aliases.items()} for m in registered_models(client)}


def local_folder(uri: str, settings: Settings) -> str:
    """The local folder of a model's files; downloaded if the store is remote.

    A logged model is taken by its address: MLflow writes into the folder of one that it is to load by its name.
    """
    client = open_store(settings)
    with store_errors(settings):
        if uri.startswith("models:/m-"):
            uri = client.get_logged_model(uri.removeprefix("models:/")).artifact_location
        return str(mlflow.artifacts.download_artifacts(artifact_uri=uri, tracking_uri=settings.store_uri))


def _against(
    champion: ModelVersion, result: GridResult, choice: Choice, settings: Settings, batches: Sequence[Batch]
) -> tuple[Comparison | None, str, str]:
    """The paired comparison with a champion (None with the obstacle), and the reason as a sentence."""
    tags = champion.tags
    try:
        then = load_training(tags.get("training_id", ""), settings).result
    except InputError as error:
        why = f"the champion (version {champion.version}) cannot be compared ({error}); it stays"
        return None, str(error), why
    rule = settings.promotion
    new = left_out(result, rule, choice.selector, choice.family, choice.n_tsp)
    old = left_out(then, rule, tags["selector"], tags["family"], int(tags["n_tsp"]))
    known = set(then.batches["batch_id"])
    unseen = [b for b in batches if b.batch_id not in known]
    judging = pd.DataFrame({"protocol": [p for p in rule.protocols if p != "train-on-one"]})
    if unseen and len(judging):
        own = _score_unseen(champion, unseen, result.target, settings)
        old = pd.concat([old, own.merge(judging, how="cross")], ignore_index=True)
    comparison = compare_paired(new, old, rule)
    fresh = f" ({len(unseen)} of them new to the champion)" if unseen else ""
    return comparison, "", f"against version {champion.version}: {comparison.words}{fresh}"


def _score_unseen(champion: ModelVersion, unseen: Sequence[Batch], target: str, settings: Settings) -> pd.DataFrame:
    """S of the champion's own predictions on batches it was not trained on: batch_id, digest, S_um."""
    model = model_store.load(version_folder(champion.source, champion.tags, settings))
    rows = []
    for b in unseen:
        try:
            error_um = zeroed_error_um(b, target) - model.predict(b)
        except InputError:  # an input of the champion is no longer recorded: no comparison on this batch
            continue
        rows.append({"batch_id": b.batch_id, "digest": str(b.digest), "S_um": residual_std_um(error_um)})
    return pd.DataFrame(rows, columns=["batch_id", "digest", "S_um"])


@contextmanager
def _locked(name: str, settings: Settings) -> Iterator[None]:
    """One process at a time changes a model's versions and aliases."""
    folder = settings.home / "locks"
    folder.mkdir(parents=True, exist_ok=True)
    with FileLock(folder / f"{name}.lock"), database.exclusive(settings, name), store_errors(settings):
        yield


def _crown(client: MlflowClient, name: str, version: str, why: str, training_id: str, forced: bool) -> None:
    audit.move_champion(
        client, name, version, action="promote", why=why, training_id=training_id, code_version=code_version(),
        forced=forced,
    )  # fmt: skip
    _drop(client, name, CHALLENGER, PROVISIONAL)  # lost to an older champion, and stood in for one


def _drop(client: MlflowClient, name: str, *aliases: str) -> None:
    for alias in set(aliases) & client.get_registered_model(name).aliases.keys():
        client.delete_registered_model_alias(name, alias)


def _by_alias(client: MlflowClient, name: str, alias: str) -> ModelVersion | None:
    try:
        return client.get_model_version_by_alias(name, alias)
    except MlflowException as error:
        if error.error_code in ("RESOURCE_DOES_NOT_EXIST", "INVALID_PARAMETER_VALUE"):
            return None
        raise


def _text(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def _log_version(client: MlflowClient, name: str, new: Newcomer, tags: dict[str, str]) -> str:
    """Log the model of a training's run and make a registered version of it; returns its number.

    Models from code: MLflow keeps `pyfunc_model.py` and the plain files of `model_store`; nothing is pickled.
    """
    from pipelines.store import pyfunc_model
    from pipelines.store.serving import write_served  # loads onnx

    choice, result, info = new.choice, new.result, _info(new)
    tags = {k: _text(v) for k, v in info.items() if k not in ("choice", "faults")} | _tags(new) | tags
    bound = RunBound.of_cell(result.distances, result.scores, choice.selector, choice.family, choice.n_tsp)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        stored = fitted_model.write(
            folder, new.family, new.machine_yaml, new.batches, new.region, info, bound, result.curves, result.stack,
            new.substitutes,
        )  # fmt: skip
        served = write_served(stored, folder, stored.info["step_s"])
        code = Path(shutil.copy(Path(pyfunc_model.__file__).resolve(), folder / model_store.CODE))
        model_store.add_hashes(folder, [code.name])
        tags |= {"sha256": model_store.digest(folder)}
        channels = stored.channels()
        drivers = [d for d in stored.machine.names("driver") if d not in channels]
        signature = ModelSignature(
            inputs=Schema([
                *(ColSpec(_NUMBER, c) for c in ("time_s", *channels)),
                *(ColSpec(_NUMBER, d, required=False) for d in drivers), ColSpec("string", "batch_id", required=False),
            ]),
            outputs=Schema([ColSpec("double", "predicted_um"), ColSpec("boolean", "outside_region")]),
        )  # fmt: skip
        model_id = _begin_model(client, new.training_id, choice)
        logged = mlflow.pyfunc.log_model(
            model_id=model_id,
            python_model=str(code),
            artifacts={f: str(folder / f) for f in (*model_store.FILES, *served)},
            signature=signature,
            input_example=_example(stored, [*channels, *drivers]),
            pip_requirements=_requirements(new.family),
        )
    simulated = result.simulated
    about = {"machine": result.machine, "target": result.target, "simulated": _text(simulated)}
    try:
        client.create_registered_model(name, tags=about)
    except MlflowException as error:
        if error.error_code != "RESOURCE_ALREADY_EXISTS":
            raise
    made = client.create_model_version(
        name, logged.model_uri, run_id=new.training_id, tags=tags, model_id=model_id,
        description=("SIMULATED. " if simulated else "") + choice.summary,
    )  # fmt: skip
    return str(made.version)


def _begin_model(client: MlflowClient, training_id: str, choice: Choice) -> str:
    """A model below a training's run, whose status stays: `mlflow.start_run` would set a finished run to running.

    A model that an interrupted promotion has left without files is removed.
    """
    run = client.get_run(training_id)
    experiment = run.info.experiment_id
    for left in client.search_logged_models([experiment], f"source_run_id = '{training_id}'"):
        if left.status == LoggedModelStatus.PENDING:
            client.delete_logged_model(left.model_id)
    model = client.create_logged_model(
        experiment, name="model", source_run_id=training_id, params=run.data.params, model_type=choice.family
    )
    client.log_outputs(training_id, [LoggedModelOutput(model.model_id, step=0)])
    at_ms = int(run.info.end_time or run.info.start_time)
    metrics = [Metric(k, v, at_ms, 0, model_id=model.model_id) for k, v in run.data.metrics.items()]
    client.log_batch(training_id, metrics=metrics)
    return str(model.model_id)


def _example(stored: model_store.StoredModel, channels: Sequence[str]) -> pd.DataFrame:
    """Three rows in the middle of each channel's plausible range."""
    step_s = stored.machine.recording.step_s
    columns: dict[str, list[float]] = {"time_s": [0.0, step_s, 2 * step_s]}
    for c in channels:
        low, high = stored.machine.channels[c].range or (20.0, 20.0)
        columns[c] = [0.5 * (low + high)] * 3
    return pd.DataFrame(columns)


def _requirements(family: Family) -> list[str]:
    """What a prediction needs; packages that only learning needs (`Family.packages`) are none of it."""
    packages = _SERVED_PACKAGES if family.has_program() else _MODEL_PACKAGES
    return [_pinned(p) for p in packages]


def _pinned(package: str) -> str:
    """The version here; of a package of an extra that is not installed, thermodrift's own range."""
    try:
        return f"{package}=={installed(package).partition('+')[0]}"
    except PackageNotFoundError:
        return next(r for r in requires("thermodrift") or () if r.startswith(package)).partition(";")[0].strip()


CHALLENGER = "challenger"
