"""`thermodrift status`: registered models, trainings and diagnoses, and what the lake holds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from pipelines import console
from pipelines.options import Json

if TYPE_CHECKING:
    import pandas as pd

TRAININGS_SHOWN = 12


def print_status(tables: Mapping[str, pd.DataFrame], lake: Mapping[str, Mapping[str, int]]) -> None:
    """Lines instead of tables: names, ids and reasons are longer than a console's 80 columns allow."""
    models, trainings, diagnoses = (tables[k] for k in ("models", "trainings", "diagnoses"))
    console.out.print("Lake", style="bold")
    for machine, held in lake.items():
        console.line(f"  {machine}: {held['batches']} batches, files in quarantine: {held['quarantined']}")
    if not lake:
        console.line("  empty; `thermodrift ingest` fills it")
    console.out.print("Registered models", style="bold")
    m: Any
    for m in models.itertuples():
        alias = f" {m.aliases}" if m.aliases else ""
        console.line(
            f"  {m.name}/{m.version}{alias}: {m.expected or f'score {m.score_um:.2f} µm'}; {m.cell} over "
            f"{m.n_batches} batches{_label(m)}{'' if m.trusted else ', no trustworthy model'}; {m.reason}"
        )
    if models.empty:
        console.line("  none; `thermodrift train` promotes the first")
    console.out.print("Latest trainings", style="bold")
    t: Any
    for t in trainings.head(TRAININGS_SHOWN).itertuples():
        became = f"; {t.promotion}" if t.promotion else ""
        console.line(
            f"  {t.training_id} {t.machine} {t.target} {t.started:%Y-%m-%d %H:%M}, {t.n_batches} batches"
            f"{_label(t)}: {t.best}{became}"
        )
    if trainings.empty:
        console.line("  none")
    if not diagnoses.empty:
        console.out.print("Last diagnosis of each machine", style="bold")
    d: Any
    for d in diagnoses.drop_duplicates("machine").itertuples():
        found = f"; {d.mechanism.replace('_', ' ')}, {d.where} ({100 * d.probability:.0f} %)" if d.mechanism else ""
        console.line(
            f"  {d.run_id} {d.machine} {d.started:%Y-%m-%d %H:%M}, {d.n_batches} batches{_label(d)}: "
            f"{d.verdict.replace('_', ' ')}{found}"
        )


def _label(row: Any) -> str:
    return ", simulated" if row.simulated else ""


def status(as_json: Json = False) -> None:
    """Which version runs on which machine: registered models, aliases, scores; and what the lake holds."""
    from pipelines import settings

    settings.configure_environment()
    from pipelines import registry, tracking
    from pipelines.recordings import home_lake

    configured = settings.load()
    tables = {
        "models": registry.status(configured),
        "trainings": tracking.trainings(settings=configured),
        "diagnoses": tracking.diagnoses(settings=configured),
    }
    lake = home_lake()
    held = {m: {"batches": len(lake.batch_ids(m)), "quarantined": len(lake.quarantined(m))} for m in lake.machines()}
    if as_json:
        console.print_json({**{k: console.records(v) for k, v in tables.items()}, "lake": held})
    else:
        console.line(f"home {configured.home}")
        print_status(tables, held)
