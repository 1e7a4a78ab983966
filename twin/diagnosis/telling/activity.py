"""When an effect is at work: the regime in a driver's words, and the stretches of each batch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from twin.calibration.fit_problem import Array
from twin.compiling.scope import several
from twin.diagnosis.proposals.candidate import Candidate
from twin.diagnosis.rounds.fitted import Fitted
from twin.mechanisms import MECHANISMS
from twin.mechanisms.base import View
from twin.schema import MechanismPart, TwinPart
from twin.simulation import Simulation, simulate

AT_WORK = 0.1  # of the largest watts
ALWAYS = 0.95  # of the time

Windows = tuple[tuple[str, float, float], ...]


def activity(fitted: Fitted, c: Candidate) -> tuple[str, Windows]:
    """The regime ("spindle_rpm > 0", "always", "at times") and windows (batch, start s, end s), none where always.

    By what the law itself says, else while its drivers run, those of the heat that it multiplies included, else by the
    watts that it makes.
    """
    if c.part is None:
        return "always", ()
    if (stated := _stated(fitted, c)) is not None:
        return "at times", stated
    roles = fitted.batches[0].channels
    switched = [n for n in _drivers(c.part, fitted.part) if roles[n].role == "driver"]
    if switched:
        on = {b.batch_id: np.all([b.values(n) != 0 for n in switched], axis=0) for b in fitted.batches}
        times = {b.batch_id: b.time_s for b in fitted.batches}
        return " and ".join(f"{n} > 0" for n in switched), _windows(on, times)
    return _by_watts(fitted, c.name)


def _by_watts(fitted: Fitted, name: str) -> tuple[str, Windows]:
    """The same by a heat's size, where it is above a share of its largest; always, where it is none."""
    if not any(h.law.name == name for h in fitted.problem.network.heats):
        return "always", ()
    run = _simulated(fitted, fitted.values)
    watts = np.abs(run.heat_W[name][0])
    on_rows = (watts > AT_WORK * watts[run.valid].max(initial=0.0)) & run.valid
    if on_rows[run.valid].mean() > ALWAYS:
        return "always", ()
    on = {b: on_rows[k, run.valid[k]] for k, b in enumerate(run.batch_ids)}
    times = {b: run.time_s[k, run.valid[k]] for k, b in enumerate(run.batch_ids)}
    return "at times", _windows(on, times)


def usual_size(fitted: Fitted, c: Candidate) -> float:
    """Root mean square of a heat's watts, or of what a displacement adds to its error, where it is not next to none."""
    run = _simulated(fitted, fitted.values)
    if c.where.kind == "node":
        series = run.heat_W[c.name][0]
    else:
        without = fitted.values.copy()
        for amplitude, off in c.amplitudes.items():
            without[fitted.problem.network.index(f"mechanisms.{c.name}.{amplitude}")] = off
        column = [e.channel for e in fitted.problem.network.errors].index(c.where.name)
        series = (run.errors - _simulated(fitted, without).errors)[0, ..., column]
    series = np.abs(series[run.valid])
    series = series[np.isfinite(series)]
    at_work = series[series > AT_WORK * series.max(initial=0.0)]
    return float(np.sqrt(np.mean(at_work**2))) if len(at_work) else 0.0


def _simulated(fitted: Fitted, values: Array) -> Simulation:
    problem, nuisance = fitted.problem, fitted.state.nuisance
    start, offset = problem.own(nuisance)
    return simulate(problem.network, values, problem.own_heat(nuisance), start, keep_cells=True, offsets_K=offset)


def _stated(fitted: Fitted, c: Candidate) -> Windows | None:
    """The windows of a law that says itself when it works."""
    if c.mechanism not in MECHANISMS:
        return None
    law, network = MECHANISMS[c.mechanism], fitted.problem.network
    values = {p.name: v for p, v in zip(network.parameters, fitted.values, strict=True)}
    own = {s.name: np.asarray(values.get(f"mechanisms.{c.name}.{s.name}", s.value)) for s in law.parameters}
    on = {}
    for b in fitted.batches:
        at_work = law().at_work(View(time_s=b.time_s), own)
        if at_work is None:
            return None
        on[b.batch_id] = at_work >= 0.5
    return _windows(on, {b.batch_id: b.time_s for b in fitted.batches})


def _drivers(given: MechanismPart, part: TwinPart) -> Sequence[str]:
    """The channels that drive a law, or else the heats that it acts on."""
    own = given.drivers
    if own:
        return [own] if isinstance(own, str) else list(own.values())
    acted_on = [part.mechanisms[n] for n in several(given.acts_on) if n in part.mechanisms]
    return list(dict.fromkeys(n for other in acted_on for n in _drivers(other, part)))


def _windows(on: Mapping[str, np.ndarray], time_s: Mapping[str, np.ndarray]) -> Windows:
    out = []
    for batch, flags in on.items():
        edges = np.flatnonzero(np.diff(np.r_[False, flags, False].astype(int)))
        for first, behind in zip(edges[::2], edges[1::2], strict=True):
            last = min(int(behind), len(time_s[batch]) - 1)
            out.append((batch, float(time_s[batch][first]), float(time_s[batch][last])))
    return tuple(out)
