"""What a diagnosis changes of a machine file: parts that are new or different, with their fitted values."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from pydantic import BaseModel

from twin.diagnosis.proposals.values_of_part import PLACES, with_value
from twin.diagnosis.rounds.fitted import Fitted
from twin.schema import TwinPart


def with_deviations(fitted: Fitted) -> TwinPart:
    """The twin part whose `per_batch` values are the deviations that the batches really have."""
    part, problem = fitted.part, fitted.problem
    for name, sd in deviations(fitted).items():
        parameter = problem.network.parameters[problem.network.index(name)]
        part = with_value(part, parameter, per_batch=float(f"{max(sd, 0.01):.2g}"))
    return part


def deviations(fitted: Fitted) -> dict[str, float]:
    """By parameter that differs from run to run the sd of its logarithm over the batches."""
    own = fitted.problem.own_deviations(fitted.state.nuisance)
    names = [fitted.problem.network.parameters[k].name for k in fitted.problem.nuisances.parameters]
    return dict(zip(names, np.sqrt(np.mean(own**2, axis=0)).tolist(), strict=True))


def changed_parts(before: TwinPart, after: TwinPart) -> Mapping[str, BaseModel]:
    """By path ("mechanisms.floor_sink_bed") what `after` states that `before` does not, or states otherwise."""
    out = {}
    for group in PLACES:
        old = getattr(before, group)
        for name, given in getattr(after, group).items():
            if name not in old or old[name] != given:
                out[f"{group}.{name}"] = given
    return out
