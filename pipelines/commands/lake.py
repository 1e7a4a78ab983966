"""`thermodrift lake`: what the lake holds, and batches out of use and back."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any

import typer

from data.errors import InputError, masked
from pipelines import console
from pipelines.options import Json

if TYPE_CHECKING:
    from data.lake import Lake
    from data.manifest import Version

app = typer.Typer(help="List the stored batches; withdraw, restore or delete some.")
MachineName = Annotated[str, typer.Argument(help="name of a machine, as in its machine file")]
Batches = Annotated[list[str], typer.Argument(help="batch ids, or patterns such as '2025*'")]
Reason = Annotated[str, typer.Option("--reason", help="why; it is shown wherever the batch is met again")]


@app.command("list")
def list_(
    machine: Annotated[str | None, typer.Argument(help="name of a machine; default: all machines")] = None,
    as_json: Json = False,
) -> None:
    """Machines in the lake, or the batches of one machine, withdrawn ones included."""
    lake = _lake()
    rows = [_machine_row(lake, m) for m in lake.machines(withdrawn=True)]
    if machine is not None:
        rows = [{"batch": i, **_version_row(versions[-1])} for i, versions in lake.contents(machine).items()]
    if as_json:
        console.print_json(rows)
    elif not rows:
        console.line("the lake is empty; `thermodrift ingest` fills it")
    else:
        hidden = ("digest", "year", "withdrawn_at")
        _print_rows(machine or lake.name, [{k: v for k, v in r.items() if k not in hidden} for r in rows])


@app.command()
def show(
    machine: MachineName,
    batch: Annotated[str, typer.Argument(help="batch id")],
    as_json: Json = False,
) -> None:
    """One batch: versions, sources, findings, withdrawal, and the trainings and models that used it."""
    lake = _lake()
    versions = lake.versions(machine, batch)
    last = versions[-1]
    kept = last.withdrawn is None or not last.withdrawn.purged_at
    content = lake.read(last) if kept else None
    findings = [f.as_dict() for f in content.findings] if content else []
    used = _trainings_with(machine, [batch])
    if as_json:
        shown = {
            "machine": machine, "batch_id": batch, "start": content.start if content else None,
            "versions": [_version_row(v) for v in versions], "findings": findings, "trainings": used,
        }  # fmt: skip
        console.print_json(shown)
        return
    start = "" if content is None or content.start is None else f", started {content.start:%Y-%m-%d %H:%M}"
    console.line(f"{machine} {batch}{start}: {_state(last)}")
    _print_rows("versions", [_version_row(v) for v in versions])
    console.line(f"findings: {len(findings)}")
    for f in findings:
        console.line(f"  {f['check']}: {f['words']}")
    console.line(f"trainings: {len(used)}")
    for u in used:
        models = f"; models {', '.join(u['models'])}" if u["models"] else ""
        console.line(f"  {u['training_id']} {u['target']} {u['started']}, version {u['version']} of the batch{models}")


@app.command()
def withdraw(machine: MachineName, batches: Batches, reason: Reason, as_json: Json = False) -> None:
    """Take batches out of use until `restore`: no training loads them, and the same content is not stored again."""
    _print_withdrawn(machine, _lake().withdraw(machine, batches, reason), as_json)


@app.command("forget-machine")
def forget_machine(machine: MachineName, reason: Reason, as_json: Json = False) -> None:
    """Withdraw every batch of a machine; `purge --quarantined` then deletes what the lake holds of it."""
    _print_withdrawn(machine, _lake().forget_machine(machine, reason), as_json)


@app.command()
def restore(machine: MachineName, batches: Batches, as_json: Json = False) -> None:
    """Bring withdrawn batches back into use; purged ones can then be ingested again."""
    lake = _lake()
    ids = lake.restore(machine, batches)
    held = lake.batch_ids(machine)
    again = [i for i in ids if i not in held]
    if as_json:
        console.print_json({"machine": machine, "restored": [i for i in ids if i in held], "ingest_again": again})
        return
    for batch_id in ids:
        state = "its content was purged; ingest its recording again" if batch_id in again else "restored"
        console.line(f"{machine} {batch_id}: {state}")


@app.command()
def purge(
    machine: MachineName,
    batches: Annotated[
        list[str] | None, typer.Argument(help="withdrawn batches or patterns; default: all withdrawn ones")
    ] = None,
    quarantined: Annotated[
        bool, typer.Option("--quarantined", help="also delete the machine's quarantined files")
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", help="do not ask")] = False,
    as_json: Json = False,
) -> None:
    """Delete the content of withdrawn batches for good; reason and digest stay, and keep the same content out."""
    from data.manifest import chosen

    lake = _lake()
    contents = lake.contents(machine)
    doomed = {i: files for i, versions in contents.items() if (files := _withdrawn_files(lake, versions))}
    if not doomed and not quarantined:
        raise InputError(f"lake {lake.name}: no withdrawn batch of {machine} has content; nothing to purge")
    where = f"lake {lake.name}: {machine} has no withdrawn batch with content that fits"
    wanted = list(doomed) if batches is None else chosen(list(doomed), batches, where)
    size_MB = sum(lake.size(f) for i in wanted for f in doomed[i]) / 1e6
    if not yes:
        more = f" and {len(lake.quarantined(machine))} quarantined files" if quarantined else ""
        what = f"withdrawn batches of {machine}: {len(wanted)}, {size_MB:.1f} MB{more}"
        if not sys.stdin.isatty():
            raise InputError(f"purge deletes for good ({what}); give --yes where nobody can be asked")
        typer.confirm(f"Delete for good: {what}?", abort=True)
    ids = lake.purge(machine, wanted, quarantined)
    if as_json:
        console.print_json({"machine": machine, "purged": ids, "quarantined": quarantined})
        return
    for batch_id in ids:
        console.line(f"{machine} {batch_id}: purged")


@app.command()
def migrate(as_json: Json = False) -> None:
    """Bring a lake of an earlier version into the present form, and sign its manifests where `lake_key` is set."""
    from data.lake_migration import migrate
    from pipelines import settings

    configured = settings.load()
    done = migrate(configured.lake, configured.lake_key)
    if as_json:
        console.print_json({"machines": done.machines, "files_read": done.files, "damaged": done.damaged})
        return
    signed = ", signed" if configured.lake_key else ""
    console.line(
        f"lake {masked(configured.lake)}: manifests written{signed}: {len(done.machines)}; files read: {done.files}"
    )
    for line in done.damaged:
        console.note(f"damaged: {line}; ingest its source again")


def _lake() -> Lake:
    from pipelines.jobs.recordings import home_lake  # takes long to load

    return home_lake()


def _withdrawn_files(lake: Lake, versions: Sequence[Version]) -> list[str]:
    """Files of withdrawn versions that are still there."""
    return [f for v in versions if v.withdrawn and not v.withdrawn.purged_at for f in v.files if lake.size(f)]


def _print_withdrawn(machine: str, ids: Sequence[str], as_json: bool) -> None:
    models = sorted({m for u in _trainings_with(machine, ids) for m in u["models"]})
    if as_json:
        console.print_json({"machine": machine, "withdrawn": list(ids), "models": models})
        return
    for batch_id in ids:
        console.line(f"{machine} {batch_id}: withdrawn")
    if models:
        console.line(f"models that were trained with these batches: {', '.join(models)}; train again to replace them")


def _trainings_with(machine: str, batch_ids: Sequence[str]) -> list[dict[str, Any]]:
    """Trainings that used one of the batches, newest first, with the model versions made from them."""
    import json

    from pipelines import settings

    configured = settings.load()
    if configured.store_file is not None and not configured.store_file.exists():
        return []
    from pipelines.store import registry, tracking

    client = tracking.open_store(configured)
    with tracking.store_errors(configured):
        runs = tracking.finished_runs(client, "training", machine=machine)
        versions = registry.status(configured)
    rows = []
    for run in runs:
        made = versions[versions["training_id"] == run.info.run_id]
        models = [f"{m.name}/{m.version} {m.aliases}".strip() for m in made.itertuples()]
        for used in run.inputs.dataset_inputs:
            if used.dataset.name in batch_ids:
                rows.append({
                    "training_id": run.info.run_id, "target": run.data.tags.get("target", ""),
                    "started": f"{tracking.started(run):%Y-%m-%d %H:%M}", "batch_id": used.dataset.name,
                    "version": json.loads(used.dataset.source)["version"],
                    "digest": next((t.value for t in used.tags if t.key == "digest"), used.dataset.digest),
                    "models": models,
                })  # fmt: skip
    return rows


def _machine_row(lake: Lake, machine: str) -> dict[str, Any]:
    contents = lake.contents(machine)
    files = {f for versions in contents.values() for v in versions for f in v.files}
    gone = sum(versions[-1].withdrawn is not None for versions in contents.values())
    return {
        "machine": machine, "batches": len(contents) - gone, "withdrawn": gone,
        "versions": sum(map(len, contents.values())), "quarantined": len(lake.quarantined(machine)),
        "size_MB": round(sum(map(lake.size, files)) / 1e6, 2),
    }  # fmt: skip


def _version_row(v: Version) -> dict[str, Any]:
    return {
        "version": v.version, "rows": v.rows, "year": v.year or None, "stored_at": v.stored_at, "source": v.source,
        "digest": v.digest, "state": _state(v), "withdrawn_at": v.withdrawn.at if v.withdrawn else None,
        "reason": v.withdrawn.reason if v.withdrawn else None,
    }  # fmt: skip


def _state(v: Version) -> str:
    if v.withdrawn is None:
        return "in use" if v.current else "replaced"
    return "purged" if v.withdrawn.purged_at else "withdrawn"


def _print_rows(title: str, rows: Sequence[dict[str, Any]]) -> None:
    """Rows as a table; a column without a value is left out, digests are cut and of times the date (UTC) is shown."""
    columns = [c for c in rows[0] if any(r[c] is not None for r in rows)]
    numbers = [c for c in columns if all(isinstance(r[c], int | float | None) for r in rows)]
    table = console.table(title, *columns, left=set(columns) - set(numbers), wrap=("source", "reason"))
    for row in rows:
        shown = {c: "" if row[c] is None else str(row[c]) for c in columns}
        shown |= {c: shown[c][:n] for c, n in (("digest", 12), ("stored_at", 10), ("withdrawn_at", 10)) if c in shown}
        table.add_row(*shown.values())
    console.out.print(table)
