"""When an effect is at work: the regime in a driver's words, and the stretches of each batch."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from twin.diagnosis.proposals.candidate import Candidate
from twin.diagnosis.rounds.fitted import Fitted
from twin.simulation import simulate

AT_WORK = 0.1  # of the largest watts
ALWAYS = 0.95  # of the time

Windows = tuple[tuple[str, float, float], ...]


def activity(fitted: Fitted, c: Candidate) -> tuple[str, Windows]:
    """The regime ("spindle_rpm > 0", "always", "at times") and windows (batch, start s, end s), none where always."""
    drivers = c.part.drivers if c.part is not None else None
    channels = [drivers] if isinstance(drivers, str) else list((drivers or {}).values())
    switched = [n for n in channels if fitted.batches[0].channels[n].role == "driver"]
    if switched:
        on = {b.batch_id: b.values(switched[0]) != 0 for b in fitted.batches}
        times = {b.batch_id: b.time_s for b in fitted.batches}
        return f"{switched[0]} > 0", _windows(on, times)
    if c.part is None or not _has_heat(fitted, c.name):
        return "always", ()
    nuisance = fitted.state.nuisance
    problem = fitted.problem
    start, offset = problem.own(nuisance)
    run = simulate(problem.network, fitted.values, problem.own_heat(nuisance), start, keep_cells=True, offsets_K=offset)
    watts = np.abs(run.heat_W[c.name][0])
    on_rows = (watts > AT_WORK * watts[run.valid].max(initial=0.0)) & run.valid
    if on_rows[run.valid].mean() > ALWAYS:
        return "always", ()
    on = {b: on_rows[k, run.valid[k]] for k, b in enumerate(run.batch_ids)}
    times = {b: run.time_s[k, run.valid[k]] for k, b in enumerate(run.batch_ids)}
    return "at times", _windows(on, times)


def _has_heat(fitted: Fitted, name: str) -> bool:
    return any(h.law.name == name for h in fitted.problem.network.heats)


def _windows(on: Mapping[str, np.ndarray], time_s: Mapping[str, np.ndarray]) -> Windows:
    out = []
    for batch, flags in on.items():
        edges = np.flatnonzero(np.diff(np.r_[False, flags, False].astype(int)))
        for first, behind in zip(edges[::2], edges[1::2], strict=True):
            last = min(int(behind), len(time_s[batch]) - 1)
            out.append((batch, float(time_s[batch][first]), float(time_s[batch][last])))
    return tuple(out)
