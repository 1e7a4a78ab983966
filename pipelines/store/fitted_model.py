"""A fitted family as a folder that serves it: with the region of its training, and what it needs at a machine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from compensation.faults import FaultCost, bridged, fault_cost
from compensation.safety import ROOM
from compensation.substitutes import Substitutes
from data.batch import Batch
from data.errors import InputError
from data.machine import parse_machine
from features.design import Design
from features.rises import zeroed_error_um
from models.base import Family
from models.families import FAMILIES
from models.protocols import PromotionRule
from models.selection.conformal import RunBound
from models.selection.crossing import unfitted, with_target
from models.selection.loss import BASELINES
from models.selection.promotion import KEYS, Choice, Losses, pick
from models.selection.result import GridResult
from models.selection.trust import Region
from models.selection.updating import Updater, left_out_tracks, out_of_fold
from pipelines.store import model_store


def write(
    folder: Path,
    family: Family,
    machine_yaml: str,
    batches: Sequence[Batch],
    region: Region | None = None,
    info: Mapping[str, Any] | None = None,
    bound: RunBound | None = None,
    curves: pd.DataFrame | None = None,
    peers: pd.DataFrame | None = None,
    substitutes: Substitutes | None = None,
) -> model_store.StoredModel:
    """Write the model folder of a family that was fitted on these batches, and read it back.

    Args:
        machine_yaml: text of the machine file; it is stored with the model.
        region: where the model was trained; default: from the batches.
        info: what else is kept with the model, plain data.
        bound: the bound of a run's error; without it predictions state none.
        curves: left-out predictions of the training, see `GridResult.curves`; without them the family is fitted again
            to learn what readings of a probe are worth.
        peers: other families, see `GridResult.stack`; without them nobody disagrees with the model.
        substitutes: of the sensors; default: learned from the batches, see `guarded`.

    Raises:
        InputError: a family that is not fitted, or a machine file that cannot be used.
    """
    known = {
        "step_s": step_s(batches),
        "trained": _trained(family, batches),
        "largest_um": _largest_um(family, batches),
    }
    updater = _updater(family, machine_yaml, batches, curves)
    substitutes = substitutes or guarded(family, batches)
    model_store.save(
        folder, family, machine_yaml, region or Region.of(batches, family.inputs), dict(info or {}) | known, bound,
        _siblings(family, machine_yaml, batches, peers), updater, substitutes,
    )  # fmt: skip
    return model_store.load(folder)


def _siblings(
    family: Family, machine_yaml: str, batches: Sequence[Batch], peers: pd.DataFrame | None
) -> tuple[Family, ...]:
    """The peers fitted on the same batches, without the family itself; a sum of them holds them already."""
    if peers is None or peers.empty or family.combines or not batches:
        return ()
    machine, known = parse_machine(machine_yaml, "machine.yml"), with_target(batches, family.target)
    fitted = []
    for key, inputs in zip(peers["family"], peers["inputs"].str.split("|"), strict=True):
        if key != family.key:
            with suppress(InputError):
                fitted.append(unfitted(key).fit(known, inputs, family.target, machine))
    return tuple(fitted)


def step_s(batches: Sequence[Batch]) -> float:
    """Time between the rows that the model was trained on; 0 where there are none."""
    return max((b.step_s for b in batches if b.n_rows > 1), default=0.0)


def _trained(family: Family, batches: Sequence[Batch]) -> dict[str, list[float]]:
    """Least and greatest value of every raw channel of the inputs in the training."""
    found = {}
    for channel in dict.fromkeys(i.partition("@")[0] for i in family.inputs):
        values = np.concatenate([np.empty(0), *(b.masked(channel) for b in batches if channel in b.table)])
        if np.isfinite(values).any():
            found[channel] = [float(np.nanmin(values)), float(np.nanmax(values))]
    return found


def _largest_um(family: Family, batches: Sequence[Batch]) -> float:
    """Largest error in the training, relative to each batch's start, µm; 0 without batches."""
    errors = [np.abs(zeroed_error_um(b, family.target)) for b in batches]
    return float(max((np.nanmax(e) for e in errors if np.isfinite(e).any()), default=0.0))


def _updater(
    family: Family, machine_yaml: str, batches: Sequence[Batch], curves: pd.DataFrame | None
) -> Updater | None:
    """The filter of readings; None where the batches are too few for it, or where the family does not run at a machine:
    some of those take minutes to be fitted again."""
    if not batches or not family.has_program():
        return None
    ordered = _ordered(batches)
    with suppress(InputError):
        machine = parse_machine(machine_yaml, "machine.yml")
        design = Design.build(ordered, family.inputs, family.target, machine)
        tracks = left_out_tracks(design, curves) if curves is not None else []
        return Updater.learn(tracks or out_of_fold(design, family.key, range(len(ordered))))
    return None


def guarded(family: Family, batches: Sequence[Batch]) -> Substitutes | None:
    """The substitutes of the sensors; None where the batches are too few, or where the family does not run at a
    machine."""
    if not batches or not family.has_program():
        return None
    with suppress(InputError):
        return substitutes_of(family, _ordered(batches))
    return None


def _ordered(batches: Sequence[Batch]) -> list[Batch]:
    return sorted(batches, key=lambda b: (b.start is None, b.start, b.batch_id))


def substitutes_of(family: Family, ordered: Sequence[Batch]) -> Substitutes:
    """What replaces the sensors of a family while they fail, learned from batches in order of time."""
    learned = Substitutes.learn(ordered, list(dict.fromkeys(i.partition("@")[0] for i in family.inputs)))
    return replace(learned, whole=bridged(family.predict_batches, family.target, ordered, learned.names))


def faults_of(family: Family, batches: Sequence[Batch], substitutes: Substitutes | None) -> FaultCost | None:
    """What failing sensors cost at the machine, from the run of the training with the largest error; None where the
    family does not run at one, the runs are too few for a guard, or its error moves no axis."""
    largest = {b.batch_id: _largest_um(family, [b]) for b in batches}
    most_um = max(largest.values(), default=0.0)
    if substitutes is None or not most_um or batches[0].channels[family.target].unit != "um":
        return None
    run = max(_ordered(batches), key=lambda b: largest[b.batch_id])
    return fault_cost(family.predict_batches, substitutes, run, ROOM * most_um)


def spared(
    faults: FaultCost, choice: Choice, result: GridResult, rule: PromotionRule, machine_yaml: str,
    batches: Sequence[Batch],
) -> str:  # fmt: skip
    """What the best judged model costs in S that the dearest fault cannot reach, since it lacks a sensor of it, and
    what its own dearest fault costs; empty where no fault matters."""
    sensors = {name for name in faults.um_per_K if name in faults.worst.partition(": ")[0].split(" and ")}
    led = rule.only(choice.protocol)  # by one protocol more cells than the finalists are judged
    losses = Losses.of(result, led)
    lacks = [
        sensors - {i.partition("@")[0] for i in inputs.split("|")} if _runs_alone(family) else set()
        for inputs, family in zip(losses.cells["inputs"], losses.cells["family"], strict=True)
    ]
    if not any(lacks):
        return f"every model that was judged reads {' and '.join(sorted(sensors))}" if sensors else ""
    labels = ["|".join(map(str, key)) for key in losses.cells[KEYS].itertuples(index=False)]
    behind_um, se_um = losses.behind(labels.index(choice.cell), losses.counted())
    at = int(np.argmin(np.where([bool(names) for names in lacks], behind_um, np.inf)))
    other, machine = pick(result, led, labels[at]), parse_machine(machine_yaml, "machine.yml")
    known = with_target(batches, result.target)
    family = unfitted(other.family).fit(known, other.inputs, result.target, machine)
    cost = faults_of(family, batches, guarded(family, batches))
    left = "" if cost is None else f", and its dearest fault costs {cost.worst_um:.3g} µm"
    named = " and ".join(sorted(lacks[at]))
    return f"without {named}, {other.name} leaves {behind_um[at]:.2g} ± {se_um[at]:.2g} µm more{left}"


def _runs_alone(family: str) -> bool:
    return family not in BASELINES and not FAMILIES[family].combines and FAMILIES[family].has_program()
