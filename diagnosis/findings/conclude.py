"""From the search to findings: place, time, size and probability of each effect, the residual, and the verdict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from data.arrays import Array
from diagnosis.candidates.free_forms import Form, phrases
from diagnosis.contracts import Candidate
from diagnosis.findings.report_data import Effect, Other, Rms, beyond_noise, context_label, place_label
from diagnosis.findings.schema import Verdict
from diagnosis.fitting.fit import Fitted
from diagnosis.formatting import Estimate
from diagnosis.policy import POLICY, Policy
from diagnosis.search.claims import Explanation, Round, explanations, probability_cap, reported
from diagnosis.search.search import Search
from twin.calibration.identifiability import Interval
from twin.mechanisms import MECHANISMS
from twin.mechanisms.base import View
from twin.quantity import Spec
from twin.schema import MechanismPart, TwinPart, several
from twin.simulation import Simulation, simulate

Windows = tuple[tuple[str, float, float], ...]


def activity(fitted: Fitted, c: Candidate) -> tuple[str, Windows]:
    """The regime of an effect ("spindle_rpm > 0", "always", "at times") and its windows (batch, start s, end s).

    The law's own statement decides, else its drivers and those of the heat that it multiplies, else its watts. An
    effect that is always at work has no windows.
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
        return " and ".join(f"{n} {_sign(fitted, n)} 0" for n in switched), _windows(on, times)
    return _by_watts(fitted, c.name)


def _sign(fitted: Fitted, driver: str) -> str:
    """How the driver's values differ from 0 where it is on: a discharge current is negative."""
    values = np.concatenate([b.values(driver) for b in fitted.batches])
    above, below = bool((values > 0).any()), bool((values < 0).any())
    return "≠" if above and below else "<" if below else ">"


def _by_watts(fitted: Fitted, name: str) -> tuple[str, Windows]:
    """`activity` of a heat: where its watts exceed a share of their largest. What is no heat is always at work."""
    if not any(h.law.name == name for h in fitted.problem.network.heats):
        return "always", ()
    run = _simulated(fitted, fitted.values)
    watts = np.abs(run.heat_W[name][0])
    on_rows = (watts > POLICY.active_min_share * watts[run.valid].max(initial=0.0)) & run.valid
    if on_rows[run.valid].mean() > POLICY.always_min_share:
        return "always", ()
    on = {b: on_rows[k, run.valid[k]] for k, b in enumerate(run.batch_ids)}
    times = {b: run.time_s[k, run.valid[k]] for k, b in enumerate(run.batch_ids)}
    return "at times", _windows(on, times)


def usual_size(fitted: Fitted, c: Candidate) -> float:
    """Root mean square of a heat's watts, or of a displacement in its error's unit, over rows where it is at work."""
    run = _simulated(fitted, fitted.values)
    if c.where.kind == "node":
        series = run.heat_W[c.name][0]
    else:
        without = fitted.values.copy()  # noqa: PD011 - no frame
        for amplitude, off in c.amplitudes.items():
            without[fitted.problem.network.index(f"mechanisms.{c.name}.{amplitude}")] = off
        column = [e.channel for e in fitted.problem.network.errors].index(c.where.name)
        series = (run.errors - _simulated(fitted, without).errors)[0, ..., column]
    series = np.abs(series[run.valid])
    series = series[np.isfinite(series)]
    at_work = series[series > POLICY.active_min_share * series.max(initial=0.0)]
    return float(np.sqrt(np.mean(at_work**2))) if len(at_work) else 0.0


def _simulated(fitted: Fitted, values: Array) -> Simulation:
    problem, nuisance = fitted.problem, fitted.fitted_nuisance
    return simulate(problem.network, values, *problem.inputs_at(nuisance), keep_cells=True)


def _stated(fitted: Fitted, c: Candidate) -> Windows | None:
    """The windows of a law that states itself when it works."""
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
        on[b.batch_id] = at_work >= POLICY.active_min_level
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


def rms_of(table: pd.DataFrame, fitted: Fitted) -> tuple[Rms, ...]:
    """Root mean squares over all left-out rows by channel, errors first."""
    errors = {e.channel for e in fitted.problem.network.errors}
    out = []
    for channel, rows in table.groupby("channel", sort=False):
        n = rows["rows"].to_numpy(float)

        def pooled(column: str, rows: pd.DataFrame = rows, n: np.ndarray = n) -> float:
            return float(np.sqrt(np.average(rows[column].to_numpy(float) ** 2, weights=n)))

        unit = str(rows["unit"].iloc[0])
        out.append(
            Rms(str(channel), unit, pooled("before"), pooled("after"), pooled("floor"), sensor=channel not in errors)
        )
    return tuple(sorted(out, key=lambda r: (r.sensor, -r.before / max(r.after, 1e-12))))


def build_effect(
    search: Search, done: Round, part: TwinPart, intervals: Mapping[str, Interval], rms: Sequence[Rms], separates: str
) -> Effect:
    """One accepted round as a finding.

    Args:
        intervals: of the final fit's parameters, by network name.
        rms: of batches left out, before and after this effect.
        separates: the run that would distinguish it from its alternatives.
    """
    best, final = done.best, search.final
    assert best is not None
    c = best.candidate
    _, nothing, unlisted = explanations(done)
    parameters, was = reported_parameters(final, c, intervals)
    regime, windows = activity(final, c)
    return replace(
        claimed_effect(done, part, final),
        parameters=parameters,
        name=c.name if c.part is not None else "",
        regime=regime,
        windows=windows,
        rms=tuple(rms),
        separates=separates,
        caps=caps(final.runs),
        evidence={
            "gain_nats": best.gain,
            "threshold_nats": float(done.threshold),
            "relative_gain": done.figures.relative_gain if done.figures else 0.0,
            "lead_share": done.figures.lead if done.figures else 0.0,
            "left_out_nats": float(best.by_run.sum()),
            "batches_improved": best.improved,
            "batches": len(final.batches),
            "absorbed_share": best.scored.absorbed,
            "probability_nothing": nothing,
            "probability_unlisted": unlisted,
            "step": 1 + next(k for k, r in enumerate(search.rounds) if r is done),
        },
        was=was,
    )


def unlisted_effect(
    effect: Effect, form: Form, final: Fitted, c: Candidate, intervals: Mapping[str, Interval]
) -> Effect:
    """A finding of no listed mechanism: its term, and its watts or displacement."""
    head = f"mechanisms.{c.name}."
    stated = {n.removeprefix(head): i for n, i in intervals.items() if n.startswith(head)}
    return replace(
        effect,
        parameters={n: Estimate(i.value, i.unit, i.low, i.high) for n, i in stated.items()},
        context=f"it follows {form.label}",
        evidence={**effect.evidence, "follows": phrases([form], {n: i.value for n, i in stated.items()})},
        size=Estimate(usual_size(final, c), "W" if form.heat else "um"),
    )


def claimed_effect(done: Round, part: TwinPart, final: Fitted) -> Effect:
    """The best of a round with its probability and the alternatives; `final` is the fit that it is reported from."""
    every, _, _ = explanations(done)
    best = next(e for e in every if e.tried is done.best)
    c = best.tried.candidate
    own = [e for e in every if e is best or e.indistinguishable]
    same = [e for e in own if (e.tried.candidate.mechanism, e.tried.candidate.where) == (c.mechanism, c.where)]
    rest = [e for e in every if e not in same]
    return Effect(
        mechanism=c.mechanism,
        where=c.where,
        place=_place_of(c, part),
        parameters={},
        probability=min(sum(e.probability for e in own), probability_cap(final.runs)),
        context=context_label(c.part, c.where, part) if c.part is not None else "",
        others=tuple(_other(e, part) for e in reported([best, *rest])),
    )


def _place_of(c: Candidate, part: TwinPart) -> str:
    """The label of the place; of a heat's amplitude that of the heat."""
    if c.change is not None and c.where.name in part.mechanisms:
        return f"{MECHANISMS[part.mechanisms[c.where.name].law].summary} ({c.where.name})"
    return place_label(c.where, part)


def _other(e: Explanation, part: TwinPart) -> Other:
    c = e.tried.candidate
    context = context_label(c.part, c.where, part) if c.part is not None else ""
    return Other(c.mechanism, c.where, _place_of(c, part), e.probability, context, e.indistinguishable)


def reported_parameters(
    final: Fitted, c: Candidate, intervals: Mapping[str, Interval]
) -> tuple[dict[str, Estimate], dict[str, float]]:
    """Fitted values of an effect, in their units, and the machine file's values of those that it corrects.

    A parameter that does nothing at the candidate's place is left out.
    """
    network = final.problem.network
    if c.change is not None:
        name = c.change.parameter.name
        found = intervals.get(name)
        was = {name: c.change.parameter.value}
        if found is None:
            return {}, was
        return {name: Estimate(found.value, found.unit, found.low, found.high)}, was
    out: dict[str, Estimate] = {}
    specs = MECHANISMS[c.mechanism].parameters if c.mechanism in MECHANISMS else ()
    places = {s: _network_name(final, c.name, s.name, c.where.name) for s in specs}
    idle = {
        s
        for s, at in places.items()
        if at and at in intervals and intervals[at].prior_shrinkage > POLICY.idle_prior_share
    }
    sizes = [s for s in specs if s.name in c.amplitudes and s not in idle]
    for spec, at in places.items():
        if at is None or spec in idle:
            continue
        if at in intervals:
            lumped = spec in sizes and not MECHANISMS[c.mechanism].fault
            more = POLICY.lumped_amplitude_sd * abs(intervals[at].value) if lumped else 0.0
            out[spec.name] = _widened(intervals[at], spec, more)
        else:
            p = network.parameters[network.index(at)]
            out[spec.name] = Estimate(p.value, p.unit)
    return out, {}


def _widened(i: Interval, spec: Spec, more: float) -> Estimate:
    """The interval of a parameter, widened by `more` in its unit."""
    if not more:
        return Estimate(i.value, i.unit, i.low, i.high)
    if i.low > 0 and i.value > more:
        up = float(np.hypot(np.log(i.high / i.value), more / i.value))
        return Estimate(i.value, i.unit, i.value * float(np.exp(-up)), i.value * float(np.exp(up)))
    low, high = float(np.hypot(i.value - i.low, more)), float(np.hypot(i.high - i.value, more))
    return Estimate(i.value, i.unit, max(i.value - low, spec.low), min(i.value + high, spec.high))


def _network_name(final: Fitted, instance: str, parameter: str, place: str) -> str | None:
    """The network name of a mechanism's parameter, in its instance or in the parts that the mechanism adds."""
    names = [p.name for p in final.problem.network.parameters]
    direct = f"mechanisms.{instance}.{parameter}"
    if direct in names:
        return direct
    ends = [n for n in names if n.endswith(f".{parameter}") and instance in n]
    if ends:
        return ends[0]
    if parameter == "temperature":
        return next((n for n in names if n == f"surroundings.{instance}.value"), None)
    if parameter == "gain":  # a link or tilt at the end of an error's chain
        own = [n for n in names if n.startswith(f"errors.{place}.") and n.endswith(".gain")]
        kept = {p.name for p in final.problem.network.parameters if p.free}
        return next((n for n in reversed(own) if n in kept), None)
    return None


def caps(n: int) -> tuple[str, ...]:
    """Remarks on what limits a probability."""
    return () if n >= POLICY.few_runs else (f"{n} run{'s' if n > 1 else ''} only",)


def slow_residual_ratio(rms: Sequence[Rms], fitted: Fitted) -> float:
    """Left-out errors of unfiltered rows, less noise, over the usual residual of a network of castings; the median.

    Both are shares of the channel's movement. Channels that move by noise only do not count.
    """
    moves = moved_rms(fitted)
    beyond = [
        float(np.sqrt(max(r.after**2 - np.nan_to_num(r.noise) ** 2, 0.0))) / moves[r.channel]
        for r in rms
        if moves.get(r.channel, 0.0) > np.nan_to_num(r.noise)
    ]
    return float(np.median(beyond or [0.0])) / POLICY.structure_error_share


def moved_rms(fitted: Fitted) -> dict[str, float]:
    """Root mean square of the difference from a run's first row, in the channel's unit, by channel."""
    squares = np.zeros((2, len(fitted.problem.channels)))
    for m in fitted.problem.measured:
        for c in m.usable.tolist():
            value = m.value[m.channel == c]
            squares[:, c] += float(np.sum((value - (0.0 if m.is_error[c] else value[0])) ** 2)), len(value)
    return {
        name: float(np.sqrt(squares[0, c] / max(squares[1, c], 1.0))) for c, name in enumerate(fitted.problem.channels)
    }


def verdict_of(
    effects: Sequence[Effect], more: bool, rms: Sequence[Rms], slow: float, runs: int, policy: Policy = POLICY
) -> Verdict:
    """The verdict on all effects of listed mechanisms: they explain the difference where the residual is noise.

    Args:
        more: whether the residual follows something that no listed mechanism does.
        rms: of batches left out, with all effects.
        slow: `slow_residual_ratio`.
    """
    if not effects:
        return "unlisted" if more else "undecidable" if slow > max_residual_ratio(runs, policy) else "consistent"
    if effects[0].probability < POLICY.stands_alone_probability and effects[0].tied:
        return "undecidable"
    return "partly_explained" if more or (policy.checks_residual and beyond_noise(rms)) else "explained"


def max_residual_ratio(runs: int, policy: Policy = POLICY) -> float:
    """The ratio of residual to structure above which something is missing, for so many runs."""
    if not policy.checks_residual:
        return float("inf")
    return POLICY.few_runs_residual_max_units if runs < POLICY.few_runs else POLICY.residual_max_units


def residual_remarks(slow: float, runs: int) -> tuple[str, ...]:
    """A remark on a residual ratio that exceeds the limit for so many runs."""
    bound, unit = max_residual_ratio(runs), 100 * POLICY.structure_error_share
    if slow <= bound:
        return ()
    return (
        f"left-out errors are {unit * slow:.0f} % of what their channels move (median over channels); up to "
        f"{unit * bound:.0f} % may be the coarse network's",
    )
