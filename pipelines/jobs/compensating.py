"""A promoted model at the machine: from the registry to a running compensation, its state on disk, its exports."""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import pandas as pd

from compensation.exports import EXPORTS
from compensation.exports.base import Export, ExportedAxis
from compensation.exports.region import checks_program, trust_program
from compensation.rehearsal import Rehearsal, failure, readings_of, rehearse
from compensation.runtime import AxisModel, Compensator
from compensation.safety import ROOM, Limits
from data.batch import Batch
from data.errors import InputError
from features.rises import feature_unit
from pipelines.settings import home
from pipelines.store.model_store import FILES, StoredModel, inner_folder, is_champion, load, registered

PERIOD_S = 10.0  # of the models: castings move in minutes, and a step costs a tenth of a millisecond
_LOST_SAMPLES = 3  # in a row before the input is stale
_LEVER_MM = 1000.0  # of an axis whose position channel has no range


def axis_model(stored: StoredModel, limits: Limits, period_s: float) -> AxisModel:
    """A stored model made ready to run every `period_s`.

    Raises:
        InputError: the family cannot run step by step, with those that can.
    """
    channels = stored.machine.batch_channels()
    family = stored.family
    empty = Batch(stored.machine.machine, "no rows", pd.DataFrame({"time_s": []}), channels)
    program = family.program(channels, period_s)
    ends_mm = stored.machine.channels[program.along].range if program.along else None
    lever_mm = max(abs(end - program.reference_mm) for end in ends_mm) if ends_mm else _LEVER_MM
    return AxisModel(
        family.target, program, family.inputs, tuple(feature_unit(empty, i) for i in family.inputs), stored.region,
        stored.region.program(channels, period_s), stored.bound, stored.updater, limits, lever_mm, stored.authority,
        stored.remark, channels[family.target].plausible,
    )  # fmt: skip


def labelled(names: Sequence[str], models: Sequence[StoredModel]) -> str:
    """The models by name, each with its remark."""
    return ", ".join(f"{n} ({m.remark})" if m.remark else n for n, m in zip(names, models, strict=True))


def check_standing(models: Mapping[str, StoredModel], provisional: bool) -> None:
    """Refuse models that may not act on a machine, by the names they were given.

    A refused model acts only as the champion of a registry: nothing but `promote --force` makes it that, and the log
    keeps who did it.

    Args:
        provisional: the operator accepts provisional models.

    Raises:
        InputError: a provisional model without the switch, or a refused one.
    """
    for name, m in models.items():
        if m.standing == "provisional" and not provisional:
            S_um, bound_um = (float(m.info.get(f"expected_S_{k}um", math.nan)) for k in ("", "bound90_"))
            raise InputError(
                f"model {name} is provisional: better than no model in most forward runs, not shown beyond doubt; it "
                f"would act with {100 * m.authority:.3g} % of its correction, expected S {S_um:.2g} µm, 90 % below "
                f"{bound_um:.2g} µm; add --provisional to accept that, or train on more runs"
            )
        if m.standing == "refused" and not is_champion(name):
            training = m.info.get("training_id") or "TRAINING"
            raise InputError(
                f"model {name} is refused: {m.info.get('caution') or 'not shown to be better than no model'}; train on "
                f"more runs, or make it the champion all the same, which acts with its whole correction: `thermodrift "
                f"promote {training} --machine FILE.yml --force`, then --model models:/{_name(name)}"
            )


def _name(model: str) -> str:
    """The registered name of a model as it was given; NAME of another form."""
    named = registered(model)
    return "NAME" if named is None else named[0]


def compensator(
    models: Sequence[StoredModel], limits: Given, period_s: float = PERIOD_S, log: Callable[[str], None] = print
) -> Compensator:
    """The models of one machine, an axis each.

    Raises:
        InputError: models of different machines, or twice the same axis.
    """
    machines = sorted({m.machine.machine for m in models})
    axes = [m.family.target for m in models]
    if len(machines) != 1 or len(set(axes)) < len(axes):
        raise InputError(
            f"compensation: got models of machine {', '.join(machines) or '(none)'} for the axes {', '.join(axes)}; "
            "expected one machine and one model for each axis"
        )
    known = [m.substitutes for m in models if m.substitutes is not None]
    widest = max(known, key=lambda s: len(s.names), default=None)  # of the most sensors: the most neighbours of each
    if widest is not None:  # a sensor may be missing for a whole run where every axis that reads it may do without it
        refused = {n for s in known for n in s.names if n not in s.whole}
        widest = replace(widest, whole=tuple(n for n in widest.whole if n not in refused))
    made = [axis_model(m, limits.of(m), period_s) for m in models]
    return Compensator(machines[0], made, widest, period_s, log)


@dataclass(frozen=True)
class Given:
    """The limits that a user gives for every axis of a machine.

    Attributes:
        max_um: largest offset, µm; None: a quarter more than the largest error of the model's training.
        rate_um_per_s: largest rate, µm/s.
        sample_s: how often samples arrive, s; None: the step of the machine file.
        stale_s: time without a usable input that is a fault, s; None: three samples, at least the default of `Limits`.
    """

    max_um: float | None = None
    rate_um_per_s: float = 0.1
    sample_s: float | None = None
    stale_s: float | None = None

    def of(self, stored: StoredModel) -> Limits:
        """The limits of one axis. Raises: InputError, one that makes no sense, or an error that moves no axis."""
        unit = stored.machine.channels[stored.family.target].unit
        if unit != "um":
            raise InputError(
                f"{stored.family.target}: its error is in {unit}; compensation and exports move an axis by um; "
                "`predict` gives this error in its own unit"
            )
        default, largest_um = Limits(), float(stored.info.get("largest_um", 0.0))
        usual_um = ROOM * largest_um if largest_um > 0 else default.max_offset_um
        every_s = stored.machine.recording.step_s if self.sample_s is None else self.sample_s
        return Limits(
            max_offset_um=usual_um if self.max_um is None else self.max_um,
            rate_um_per_s=self.rate_um_per_s,
            stale_s=max(default.stale_s, _LOST_SAMPLES * (every_s or 0.0)) if self.stale_s is None else self.stale_s,
        )


def rehearse_models(
    models: Sequence[StoredModel],
    batches: Sequence[Batch],
    given: Given,
    *,
    period_s: float = PERIOD_S,
    failures: Sequence[str] = (),
    readings: str | None = None,
    readings_h: float | None = None,
    through: str | None = None,
    done: Callable[[int, int], None] = lambda n, of: None,
) -> Rehearsal:
    """Plays batches to the models of one machine, see `compensation.rehearsal.rehearse`.

    Args:
        failures: of sensors, as "front:lost@3h+45min".
        readings: of a probe, "1h" after the start of each recording or "every 1h"; None: none.
        readings_h: hours between two readings, instead.
        through: address of a broker at which a compensation runs; None: it runs here.

    Raises:
        InputError: models, failures or batches that cannot be used; WorkError: nobody answers at the broker.
    """
    sample_s = given.sample_s or PERIOD_S
    failing = [failure(text) for text in failures]
    if readings is not None and readings_h is not None:
        raise InputError("readings: got a text and hours between two; give one of them, e.g. every 1h")
    given_text = readings if readings_h is None else f"every {readings_h}h"
    reads = None if given_text is None else readings_of(given_text)
    axes = [m.family.target for m in models]
    how = (sample_s, min(given.of(m).tick_s for m in models), failing, reads, done)
    if through is None:
        running = compensator(models, given, period_s, lambda line: None)
        return rehearse(batches, axes, lambda s: running.take(s, s.time_s), *how)
    from compensation.connectors.mqtt import MqttExchange  # loads paho

    with closing(MqttExchange(through)) as exchange:
        return rehearse(batches, axes, exchange, *how)


def write_export(
    models: Mapping[str, Path],
    to: str,
    out: Path | None = None,
    given: Given | None = None,
    period_s: float = PERIOD_S,
    provisional: bool = True,
) -> tuple[Export, list[Path]]:
    """Writes the models of one machine, folders by the names they are given, in one of the forms of `EXPORTS`.

    Args:
        provisional: see `check_standing`.

    Returns:
        What the files state, and the files.

    Raises:
        InputError: an unknown form, models of different machines, a family that the form cannot express, or a model
            that may not act.
    """
    exporter = EXPORTS[to]()
    stored = {name: load(folder) for name, folder in models.items()}
    check_standing(stored, provisional)
    export = export_of(stored, models, given or Given(), period_s)
    return export, exporter.write(export, out or home() / "export" / export.machine)


def export_of(models: Mapping[str, StoredModel], folders: Mapping[str, Path], limits: Given, period_s: float) -> Export:
    """Models of one machine by their names, ready for an export.

    Raises:
        InputError: see `compensator` and `Family.program`.
    """
    # A control samples at the step of the program.
    running = compensator(list(models.values()), replace(limits, sample_s=limits.sample_s or period_s), period_s)
    digest = hashlib.sha256()
    for folder in folders.values():
        for name in FILES:
            digest.update((inner_folder(folder) / name).read_bytes())
    axes = []
    for stored, made in zip(models.values(), running.axes, strict=True):
        trained = {c: (low, high) for c, (low, high) in stored.info.get("trained", {}).items()}
        # A file for a control has no place for a share: its outputs are the share of the error.
        program = made.program if made.share == 1.0 else made.program.scaled(made.share)
        remark = made.remark + ("; its outputs are that share" if made.share < 1.0 else "")
        channels = stored.machine.batch_channels()
        plausible = {c: channels[c].plausible for c in program.channels}
        trust = trust_program(made, channels)
        guard, checks = running.guard, None
        if guard is not None and set(guard.substitutes.names) & set(program.channels):
            checks = checks_program(guard, program.channels, channels, period_s)
        axes.append(ExportedAxis(made.axis, program, trained, made.limits, remark, plausible, trust, checks))
    first = next(iter(models.values()))
    return Export(
        machine=first.machine.machine, model=", ".join(models), version=str(first.info.get("training_id", "")),
        digest=digest.hexdigest(), created=time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        simulated=any(m.simulated for m in models.values()), axes=tuple(axes),
    )  # fmt: skip
