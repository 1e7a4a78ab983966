"""`thermodrift registry`: champions now and at an earlier time, a model's history, and what a version was made from;
`thermodrift promote` and `thermodrift rollback`: which version of a model is the champion."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from data.errors import InputError, WorkError, closest
from pipelines import console
from pipelines.commands import load_settings
from pipelines.options import Json, MachineFile

if TYPE_CHECKING:
    import pandas as pd
    from mlflow.tracking import MlflowClient

    from pipelines.settings import Settings
    from pipelines.store.audit import Log, When

_MODEL = re.compile(r"^(?:models:/)?(?P<name>[^/@]+)(?:[/@](?P<which>[^/@]+))?$")
_START_SHOWN = 16  # to the minute
_DIGEST_SHOWN = 12


@dataclass(frozen=True)
class Lineage:
    """What a version was made from.

    - `version`: model, version, machine, target, cell, inputs, registered (UTC), code_version (at registration),
      reason, simulated, training_id, training_started (UTC), training_code_version, and champion, the times as champion
      as (since, until) in UTC. A code version that is not recorded is empty.
    - `batches`: batch_id, start, digest, version, source, n_rows, masked (channels with a finding that masks values in
      the training, joined by "|"; "*" is all channels).
    - `findings`: as `GridResult.findings`.
    """

    version: dict[str, Any]
    batches: pd.DataFrame
    findings: pd.DataFrame


def look_up(
    model: str | None, at: When | None, machine: str | None, lineage: bool, settings: Settings
) -> pd.DataFrame | Lineage:
    """The answer of the command: `overview`, `history`, `champions` or `lineage_of`, by what is given.

    Raises:
        InputError: an unknown model, version, machine or time, or arguments that exclude each other.
        WorkError: the store does not answer, or holds a log entry that cannot be read.
    """
    from pipelines.store.registry import CHAMPION
    from pipelines.store.tracking import open_store, store_errors

    match = None if model is None else _MODEL.match(model)
    if model is not None and match is None:
        raise InputError(f"registry: got {model!r}, expected NAME, or with --lineage NAME/VERSION")
    name, which = (match["name"], match["which"]) if match else (None, None)
    if name is not None and machine is not None:
        raise InputError(f"registry: got the model {name!r} and --machine {machine}; give one of them")
    if lineage and name is None:
        raise InputError("registry --lineage: no model; expected NAME/VERSION, for example my_machine-z/3")
    if which is not None and not lineage:
        raise InputError(f"registry: got {model!r}; a version has a lineage: add --lineage, or give {name!r} alone")
    if lineage and which is not None and at is not None:
        raise InputError(f"registry --lineage: got the version {which} and --at {at}; give one of them")
    client = open_store(settings)
    with store_errors(settings):
        logs = _logs(client, name, machine)
        if name is not None and logs[0].trouble:
            raise WorkError(logs[0].trouble)
        if lineage and name is not None:
            if at is not None:
                which = _only_champion(logs[0], at)
            return lineage_of(client, logs[0], which or CHAMPION, settings)
        if at is not None:
            return champions(logs, at)
        return overview(client, logs) if name is None else history(logs[0])


def overview(client: MlflowClient, logs: Sequence[Log]) -> pd.DataFrame:
    """Every model: model, machine, target, champion and provisional (versions), since (UTC), action, who, why,
    versions, note."""
    import pandas as pd

    from pipelines.store.runs import versions_by_model

    columns = ["model", "machine", "target", "champion", "provisional", "since", "action", "who", "why", "versions",
               "note"]  # fmt: skip
    rows, versions = [], versions_by_model(client)
    for log in logs:
        reign = log.reigns[-1] if log.reigns and log.reigns[-1].version == log.champion else None
        note = log.reigns[-1].note if log.reigns else log.silence()
        entry = reign.entry if reign else None
        rows.append({
            "model": log.model, "machine": log.machine, "target": log.target, "champion": log.champion,
            "provisional": log.provisional, "since": entry and entry.when, "action": entry.action if entry else "",
            "who": entry.who if entry else "", "why": entry.why if entry else "", "versions": len(versions[log.model]),
            "note": note,
        })  # fmt: skip
    return _typed(pd.DataFrame(rows, columns=columns))


def history(log: Log) -> pd.DataFrame:
    """Every entry of a model's log, oldest first: the fields of `audit.Entry`, until (UTC, the end as champion),
    carried_out (False: interrupted, the champion did not change) and note."""
    import pandas as pd

    from pipelines.store.audit import Entry

    by_entry = {id(r.entry): r for r in log.reigns}
    rows = []
    for entry, done in zip(log.entries, log.carried_out, strict=True):
        reign = by_entry.get(id(entry))
        note = reign.note if reign else "interrupted, or still running: the champion did not change"
        rows.append({**entry.model_dump(), "until": reign and reign.until, "carried_out": done, "note": note})
    return _typed(pd.DataFrame(rows, columns=[*Entry.model_fields, "until", "carried_out", "note"]))


def champions(logs: Sequence[Log], at: When) -> pd.DataFrame:
    """Champion of every model at a time, or every champion in the course of a day: model, machine, target, version,
    since and until (UTC), action, who, why, training_id, code_version (at the promotion), note.

    A model that had none, or of which that is not recorded, has no version and the reason in note.

    Raises:
        InputError: no time, a time in the future, or one at which no model had a champion.
    """
    import pandas as pd

    from pipelines.store.audit import span_of

    span = span_of(at)
    columns = ["model", "machine", "target", "version", "since", "until", "action", "who", "why", "training_id",
               "code_version", "note"]  # fmt: skip
    rows = []
    for log in logs:
        own = {"model": log.model, "machine": log.machine, "target": log.target}
        reigns = log.champions(span)
        rows += [
            {**r.entry.model_dump(), **own, "version": r.version, "since": r.since, "until": r.until, "note": r.note}
            for r in reigns
        ] or [{**own, "note": log.silence()}]
    if rows and all("version" not in r for r in rows):
        name, note = rows[0]["model"], rows[0]["note"]
        what = f"model {name!r} had no recorded champion {span}"
        if len(rows) > 1:
            what, note = f"none of {len(rows)} models had a recorded champion {span}", f"{name}: {note}"
        raise InputError(f"{what}; {note}; `thermodrift registry {name}` lists its history")
    table = pd.DataFrame(rows, columns=columns)
    texts = ["action", "who", "why", "training_id", "code_version"]
    return _typed(table.fillna(dict.fromkeys(texts, "")))


def lineage_of(client: MlflowClient, log: Log, which: str, settings: Settings) -> Lineage:
    """The version by number or alias, its training, batches, code versions and findings.

    Raises:
        InputError: unknown version or alias, or a training that the store has no longer.
    """

    from pipelines.store.registry import find_version
    from pipelines.store.tracking import load_training

    version = find_version(client, log.model, which)
    tags, number = version.tags, int(version.version)
    training = load_training(tags.get("training_id", ""), settings)
    result = training.result
    findings = result.findings.reindex(
        columns=list(dict.fromkeys([*result.findings, "channel", "masks", "overruled", "words"]))
    )
    hits = findings[findings["masks"].eq(True) & ~findings["overruled"].fillna("").astype(bool)]
    channels = hits["channel"].astype(object).fillna("*").astype(str).groupby(hits["batch_id"].astype(str)).unique()
    batches = result.batches.copy()
    batches["masked"] = ["|".join(channels.get(str(b), ())) for b in batches["batch_id"]]
    columns = ["batch_id", "start", "digest", "version", "source", "n_rows", "masked"]
    return Lineage(
        {
            "model": log.model, "version": number, "machine": log.machine, "target": log.target,
            "cell": tags.get("cell", ""), "inputs": tags.get("inputs", "").split("|"),
            "registered": tags.get("trained_at", ""), "code_version": tags.get("code_version", ""),
            "reason": tags.get("reason", ""), "simulated": training.simulated, "training_id": training.training_id,
            "training_started": training.started.isoformat(), "training_code_version": training.code_version,
            "champion": [
                (r.since.isoformat(), r.until.isoformat() if r.until else None) for r in log.reigns
                if r.version == number
            ],
        },
        batches.reindex(columns=columns).reset_index(drop=True),
        findings.reset_index(drop=True),
    )  # fmt: skip


def _logs(client: MlflowClient, name: str | None, machine: str | None) -> list[Log]:
    """The log of a model, or those of all models (of one machine) that thermodrift registered, by name."""
    from pipelines.store.audit import read
    from pipelines.store.registry import find_model
    from pipelines.store.runs import registered_models

    if name is not None:
        return [read(find_model(client, name))]
    own = (m for m in registered_models(client) if "machine" in m.tags)  # a shared server has those of other programs
    logs = sorted(map(read, own), key=lambda log: log.model)
    if machine is None:
        return logs
    known = sorted({log.machine for log in logs})
    if machine not in known:
        hint = closest(machine, known) if known else "the registry is empty; train first"
        raise InputError(f"--machine: no registered model of machine {machine!r}; {hint}")
    return [log for log in logs if log.machine == machine]


def _only_champion(log: Log, at: When) -> str:
    from pipelines.store.audit import span_of

    versions = list(dict.fromkeys(champions([log], at)["version"].astype(int)))
    if len(versions) > 1:
        raise InputError(
            f"registry --lineage: {log.model} had several champions {span_of(at)}: versions "
            f"{', '.join(map(str, versions))}; give a time such as 2026-03-03T10:00, or {log.model}/{versions[0]}"
        )
    return str(versions[0])


def _typed(table: pd.DataFrame) -> pd.DataFrame:
    """Versions as whole numbers that may be missing, times in UTC."""
    import pandas as pd

    for column in {"champion", "provisional", "version", "from_version", "to_version"} & set(table):
        table[column] = table[column].astype("Int64")
    for column in {"when", "since", "until"} & set(table):
        table[column] = pd.to_datetime(table[column], utc=True)
    return table


def registry(
    model: Annotated[
        str | None, typer.Argument(metavar="[MODEL]", help="NAME: its history; NAME/3 with --lineage; default: all")
    ] = None,
    at: Annotated[
        str,
        typer.Option(metavar="TIME", help="champions on 2026-03-03, or at 2026-03-03T10:00; local unless it says Z"),
    ] = "",
    machine: Annotated[str, typer.Option("--machine", help="machine name: its models only")] = "",
    lineage: Annotated[
        bool, typer.Option("--lineage", help="a version's training, batches with digests, code and findings")
    ] = False,
    as_json: Json = False,
) -> None:
    """Which version is or was the champion, who made it that and why, and what it was made from."""
    found = look_up(model, at or None, machine or None, lineage, load_settings())
    if as_json:
        console.print_json(_plain(found, at))
    elif isinstance(found, Lineage):
        _print_lineage(found)
    elif at:
        _print_champions(found, at)
    elif model is not None:
        _print_history(model, found)
    else:
        _print_overview(found)


def _plain(found: pd.DataFrame | Lineage, at: str) -> Any:
    from pipelines.store.audit import span_of

    if isinstance(found, Lineage):
        tables = {"batches": found.batches, "findings": found.findings}
        return {**found.version, **{k: console.records(v) for k, v in tables.items()}}
    if not at:
        return console.records(found)
    span = span_of(at)
    times = {"from": span.start.isoformat(), "until": span.end.isoformat()}
    return {**times, "champions": console.records(found)}


def _print_overview(table: pd.DataFrame) -> None:
    if table.empty:
        console.line("no model is registered; `thermodrift train` promotes the first")
    for m in _rows(table):
        now = "no champion" if m["champion"] is None else f"champion version {m['champion']}"
        now += "" if m["provisional"] is None else f"; version {m['provisional']} is provisional"
        since = f" since {_local(m['since'])} ({m['action']} by {m['who']})" if m["since"] else ""
        note = f"; {m['note']}" if m["note"] else ""
        console.line(f"{m['model']}: {now}{since}; versions: {m['versions']}{note}")


def _print_history(name: str, table: pd.DataFrame) -> None:
    console.line(f"{name}, times are local")
    if table.empty:
        console.line("  no entry; `thermodrift promote` and `thermodrift rollback` write the log")
    for e in _rows(table):
        before = "none" if e["from_version"] is None else e["from_version"]
        force = " by force" if e["forced"] and not e["why"].startswith("by force") else ""
        console.line(
            f"  {_local(e['when'])} {e['action']}{force} {before} → {e['to_version']}, {e['who']} on {e['host']}: "
            f"{e['why']}"
        )
        console.line(f"    training {e['training_id']}, {e['code_version']}{'; ' + e['note'] if e['note'] else ''}")


def _print_champions(table: pd.DataFrame, at: str) -> None:
    from pipelines.store.audit import span_of

    console.line(span_of(at))
    if table.empty:
        console.line("  no model is registered; `thermodrift train` promotes the first")
    for c in _rows(table):
        if c["version"] is None:
            console.line(f"  {c['model']}: no recorded champion; {c['note']}")
            continue
        until = f"until {_local(c['until'])}" if c["until"] else "until now"
        note = f"; {c['note']}" if c["note"] else ""
        console.line(
            f"  {c['model']}: version {c['version']}, since {_local(c['since'])} {until}; {c['action']} by {c['who']}: "
            f"{c['why']}{note}"
        )


def _print_lineage(found: Lineage) -> None:
    from pipelines.commands.ingest import print_findings

    v = found.version
    simulated = " (simulated recordings)" if v["simulated"] else ""
    console.line(f"{v['model']} version {v['version']}: {v['cell']}{simulated}; {v['reason']}")
    console.line(f"  machine {v['machine']}, error channel {v['target']}, inputs {', '.join(v['inputs']) or 'none'}")
    console.line(f"  registered {_local(_time(v['registered']))} by {v['code_version'] or 'a version not recorded'}")
    for since, until in v["champion"]:
        console.line(f"  champion from {_local(_time(since))} until {_local(_time(until)) if until else 'now'}")
    if not v["champion"]:
        console.line("  never champion by the log")
    code = v["training_code_version"] or "a version not recorded"
    console.line(f"  training {v['training_id']}, {_local(_time(v['training_started']))} by {code}")
    batches = _rows(found.batches)
    for b in batches:
        b["source"] = "" if Path(b["source"] or "").stem == b["batch_id"] else b["source"]
    columns = [c for c in map(str, found.batches) if any(b[c] not in (None, "") for b in batches)]
    table = console.table("batches", *columns, left={"batch_id", "start", "digest", "source", "masked"},
                          wrap=("source", "masked"))  # fmt: skip
    for b in batches:
        masked = ", ".join("all channels" if c == "*" else c for c in (b["masked"] or "").split("|"))
        shown = {**b, "masked": masked, "digest": str(b["digest"] or "")[:_DIGEST_SHOWN],
                 "start": str(b["start"] or "")[:_START_SHOWN]}  # fmt: skip
        table.add_row(*("" if shown[c] is None else str(shown[c]) for c in columns))
    console.out.print(table)
    console.line(f"findings: {len(found.findings)}; --json has all of them, and whole digests")
    print_findings(found.findings)


def _rows(table: pd.DataFrame) -> list[dict[str, Any]]:
    """Rows of plain values, None for what is missing."""
    plain = table.astype(object).where(table.notna(), None)
    return [
        {str(k): v.to_pydatetime() if hasattr(v, "to_pydatetime") else v for k, v in row.items()}
        for row in plain.to_dict("records")
    ]


def _time(text: str) -> datetime | None:
    return datetime.fromisoformat(text) if text else None


def _local(when: datetime | None) -> str:
    from pipelines.store.audit import stamp

    return "at a time not recorded" if when is None else stamp(when)


def promote(
    training: Annotated[str, typer.Argument(help="training id, as `thermodrift status` lists it")],
    machine: MachineFile,
    cell: Annotated[str, typer.Option(help="selector|family|n_tsp; default: by the rule in mlflow.yml")] = "",
    force: Annotated[bool, typer.Option("--force", help="replace the champion though it is not beaten")] = False,
) -> None:
    """Promote a cell of a tracked training: refit on its batches, register, compare with the champion."""
    settings = load_settings()
    from pipelines.jobs.training import promote_tracked

    console.line(promote_tracked(training, machine, cell, force, settings).summary)


def rollback(
    model: Annotated[str, typer.Argument(help="registered model, MACHINE-CHANNEL")],
    reason: Annotated[str, typer.Option("--reason", help="why; `thermodrift registry MODEL` shows it")] = "",
    of: Annotated[
        int | None, typer.Option("--of", help="the version to roll back; where it is not champion, nothing changes")
    ] = None,
) -> None:
    """Make the champion before the present one the champion again; what was rolled back is not returned to."""
    settings = load_settings()
    from pipelines.store import registry

    console.line(registry.rollback(model, settings, reason, of).summary)
