"""Priors of candidates: the usual size of an amplitude, and how far it may be from that."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from diagnosis.candidates.library import log_prior_odds, outlets_of
from diagnosis.contracts import Candidate, Point, Scored
from diagnosis.policy import POLICY
from twin.mechanisms import MECHANISMS
from twin.quantity import Spec, Value, convert, same_dimension
from twin.schema import TwinPart

SIZE_UNITS = ("W", "W/K", "m**2")  # units of what goes with the size


def size_of(fitted: Point) -> float:
    """Geometric mean of the fitted conductances over a machine tool's; 1 where that is within `machine_size_factor`."""
    network = fitted.problem.network
    conductances = np.array([float(e.conductance(fitted.values)) for e in network.edges])
    known = conductances[conductances > 0]
    if not len(known):
        return 1.0
    ratio = float(np.exp(np.mean(np.log(known)))) / POLICY.typical_conductance_W_per_K
    return 1.0 if 1.0 / POLICY.machine_size_factor < ratio < POLICY.machine_size_factor else ratio


def at_size(spec: Spec, size: float) -> Spec:
    """The Spec with the usual value of a machine of that size."""
    if (
        size == 1.0
        or spec.scale != "log"
        or not spec.value
        or not any(same_dimension(spec.unit, u) for u in SIZE_UNITS)
    ):
        return spec
    return replace(spec, value=float(np.clip(spec.value * size, spec.low, spec.high)))


def free_values(s: Scored, now: Point) -> Mapping[str, Value]:
    """A candidate's free values with priors, by parameter; none where it changes a value or exchanges labels.

    The prior's centre is the usual value; its spread is wide, and wider where the screen shows an unusual amplitude.
    """
    c = s.candidate
    if c.mechanism not in MECHANISMS:
        return {}
    mechanism, size = MECHANISMS[c.mechanism], size_of(now)
    values: dict[str, Value] = {}
    found = _in_proportion(s, size)
    for amplitude, off in c.amplitudes.items():
        spec = at_size(mechanism.spec(amplitude), size)
        if mechanism.any_unit:  # per unit of whatever drives it: no size is usual
            spec = replace(spec, spread=POLICY.unusual_size_factor * s.prior / POLICY.signed_prior_sd_factor)
        values[amplitude], begin = _free(spec, off, off + found.get(amplitude, 0.0))
        if "expand" in mechanism.effects():  # it is elsewhere in the network, under another name
            usual = values[amplitude].value
            values[amplitude] = values[amplitude].model_copy(update={"value": _said(begin, spec.unit), "prior": usual})
    for name in c.shape:
        spec = _stated(mechanism.spec(name), c)
        values[name] = Value(value=_said(spec.value, spec.unit), spread=_spread(spec), bounds=_bounds(spec))
    if mechanism.off is None:
        values |= {
            p.name: Value(value=_said(p.value, p.unit), spread=_spread(p), bounds=_bounds(p))
            for p in mechanism.parameters
            if p.value is not None and p.spread is not None
        }
    return values


def _in_proportion(s: Scored, size: float) -> dict[str, float]:
    """The amplitudes where a fit begins: one that the screen found, and others of the same law in their usual ratio."""
    specs = {a: at_size(MECHANISMS[s.candidate.mechanism].spec(a), size) for a in s.candidate.amplitudes}
    found = {a: v for a, v in s.amplitudes.items() if a in specs}
    if len(found) != 1 or len(specs) == 1 or any(spec.scale != "log" or not spec.value for spec in specs.values()):
        return found
    ((name, value),) = found.items()
    share = value / (specs[name].value or 1.0) / len(specs)
    return {a: share * (spec.value or 0.0) for a, spec in specs.items()}


def _free(spec: Spec, off: float, begin: float) -> tuple[Value, float]:
    if spec.scale == "linear":
        usual = POLICY.signed_prior_sd_factor * (1.0 if spec.spread is None else spec.spread)
        spread = max(usual, POLICY.signed_start_factor * abs(begin - off)) or 1.0
        low, high = spec.low, spec.high
        begin = float(np.clip(begin, low, high))
        return Value(value=_said(off, spec.unit), spread=_said(spread, _delta(spec)), bounds=_bounds(spec)), begin
    usual = spec.value or 1.0
    if spec.scale == "logit":
        margin = POLICY.start_share_margin
        begin = float(np.clip(begin, margin, 1.0 - margin))
        usual = float(np.clip(usual, margin, 1.0 - margin))
        return Value(
            value=_said(usual, spec.unit),
            spread=max(POLICY.amplitude_min_log_sd, spec.spread or 0.0),
            bounds=_bounds(spec),
        ), begin
    low = max(spec.low, POLICY.start_min_amplitude_share * usual)
    begin = float(np.clip(begin, max(low, POLICY.start_min_amplitude_share * usual), spec.high))
    spread = max(
        POLICY.amplitude_min_log_sd, spec.spread or 0.0, abs(float(np.log(begin / usual))) / POLICY.amplitude_start_sd
    )
    return Value(value=_said(usual, spec.unit), spread=spread, bounds=_bounds(spec)), begin


def _spread(spec: Spec) -> str | float:
    spread = spec.spread if spec.spread is not None else POLICY.shape_default_sd
    return _said(spread, _delta(spec)) if spec.scale == "linear" else spread


def _delta(spec: Spec) -> str:
    return "K" if spec.unit == "degC" else spec.unit


def _said(value: float | None, unit: str) -> str | float:
    """The value as a machine file states it."""
    number = float(f"{value or 0.0:.5g}")
    return number if unit == "1" else f"{number:g} {unit}"


def _bounds(spec: Spec) -> tuple[str | float, str | float] | None:
    if not (np.isfinite(spec.low) and np.isfinite(spec.high)):
        return None
    return _said(spec.low, spec.unit), _said(spec.high, spec.unit)


def log_odds(c: Candidate, now: Point, variants: int) -> float:
    """Log odds of a candidate before the recordings: of its equipment, of laws that go with it at its place, and of its
    mechanism, spread over so many variants: hundreds of an unlikely law weigh no more than one."""
    out = log_prior_odds(now.machine, now.part, c) - float(np.log(max(1, variants)))
    lonely = c.mechanism in MECHANISMS and MECHANISMS[c.mechanism].goes_with and _alone(c, now.part)
    return out - POLICY.missing_companion_cost_nats if lonely else out


def _alone(c: Candidate, part: TwinPart) -> bool:
    """Whether none of the laws that go with a law is at its place."""
    return not any(
        given.law in MECHANISMS[c.mechanism].goes_with and c.where.name in outlets_of(given)
        for given in part.mechanisms.values()
    )


def _stated(spec: Spec, c: Candidate) -> Spec:
    """The Spec with the candidate's own value, where a shape was looked for at several."""
    given = c.part.parameters.get(spec.name) if c.part is not None else None
    return spec if given is None else replace(spec, value=convert(given.value, spec.unit))
