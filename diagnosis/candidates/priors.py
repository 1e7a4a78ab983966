"""Priors of candidates: the usual size of an amplitude, and where its fit starts."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from diagnosis.candidates.library import log_prior_odds, outlets_of
from diagnosis.contracts import Candidate, Fitted, Scored
from diagnosis.policy import POLICY
from twin.calibration.least_squares import x_of, z_bounds
from twin.mechanisms import MECHANISMS
from twin.quantity import Spec, Value, convert, same_dimension
from twin.schema import TwinPart

SIZE_UNITS = ("W", "W/K", "m**2")  # units of what goes with the size


def size_of(fitted: Fitted) -> float:
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


def start_values(s: Scored, now: Fitted) -> tuple[Mapping[str, Value], Mapping[str, float]]:
    """A candidate's free values with priors, and parameter values by network name where its fit begins.

    The prior's centre is the usual value, its spread wide; the fit begins at the amplitude that the screen found.
    """
    c = s.candidate
    if c.change is not None:
        name = c.change.parameter.name
        value = c.change.parameter.value
        most = POLICY.start_max_log_factor
        factor = float(np.exp(np.clip(s.amplitudes.get("factor", 0.0), -most, most)))
        p = c.change.parameter
        margin = POLICY.start_share_margin if p.scale == "logit" else 0.0  # no share begins at 0 or 1: its logit is ∞
        begin = float(np.clip(value * factor, p.low + margin, p.high - margin))
        return {}, {name: begin} if c.change.spread else {}
    if c.parts:
        return {}, {}
    mechanism = MECHANISMS[c.mechanism]
    values: dict[str, Value] = {}
    at: dict[str, float] = {}
    size = size_of(now)
    for amplitude, off in c.amplitudes.items():
        spec = at_size(mechanism.spec(amplitude), size)
        if mechanism.any_unit:  # per unit of whatever drives it: no size is usual
            spec = replace(spec, spread=0.0)
        begin = off + s.amplitudes.get(amplitude, 0.0)
        values[amplitude], begin = _free(spec, off, begin)
        at[f"mechanisms.{c.name}.{amplitude}"] = begin
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
    return values, at


def starts(s: Scored, now: Fitted) -> Iterator[tuple[Mapping[str, Value], Mapping[str, float]]]:
    """Free values and start values of a refit, in the order of trial.

    A linear step may lead to a machine that cannot be simulated, as where heat that feeds itself runs away.
    """
    values, at = start_values(s, now)
    yield values, {**_joint_start(s, now), **at}
    yield values, at
    for share in POLICY.start_amplitude_shares if s.amplitudes else ():
        yield start_values(replace(s, amplitudes={a: share * v for a, v in s.amplitudes.items()}), now)


def _joint_start(s: Scored, now: Fitted) -> dict[str, float]:
    """Start values of the fit's own parameters: the linear joint optimum with the candidate.

    From their old values some channels would start with large residuals, and their noise would be inflated.
    """
    z = now.state.z + np.array(s.moves[: len(now.state.z)]) if s.moves else now.state.z
    values = now.problem.values_at(x_of(now.problem.unknowns, np.clip(z, *z_bounds(now.problem.unknowns))))
    network = now.problem.network
    return {u.name: float(values[network.index(u.name)]) for u in now.problem.unknowns}


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


def log_prior(s: Scored, fitted: Fitted | None, like: Scored | None = None) -> float:
    """Log density of an effect's size about the usual one, 0 at best; signed amplitudes by their usual spread. Of
    several amplitudes the likeliest: they are parts of one effect, and any may be none.

    Where `fitted` holds a candidate `like` this one instead, the screen's amplitude is scaled as that one's was by its
    fit. Each shape parameter costs `shape_parameter_cost_nats` (Schwarz 1978).
    """
    c = s.candidate
    if c.mechanism not in MECHANISMS:
        return 0.0
    mechanism = MECHANISMS[c.mechanism]
    freedom = -POLICY.shape_parameter_cost_nats * len(c.shape)
    if fitted is not None:
        freedom += log_prior_odds(fitted.machine, fitted.part, c)
    if fitted is not None and mechanism.goes_with and _alone(c, fitted.part):
        freedom -= POLICY.missing_companion_cost_nats
    size = size_of(fitted) if fitted is not None else 1.0
    sizes: list[float] = []
    for amplitude, off in (mechanism.off or {}).items():
        spec = at_size(mechanism.spec(amplitude), size)
        value = off + s.amplitudes.get(amplitude, 0.0)
        name = f"mechanisms.{c.name}.{amplitude}"
        if fitted is not None and any(p.name == name for p in fitted.problem.network.parameters):
            value = float(fitted.values[fitted.problem.network.index(name)])
        elif fitted is not None and like is not None:
            value = off + (value - off) * _grown(like, fitted)
        if spec.scale == "log" and spec.value and value > 0:
            sizes.append(
                -0.5 * (float(np.log(value / spec.value)) / max(POLICY.amplitude_min_log_sd, spec.spread or 0.0)) ** 2
            )
        elif spec.scale == "linear" and spec.spread:
            square = ((value - off) / (POLICY.signed_usual_sd_factor * spec.spread)) ** 2
            sizes.append(-0.5 * min(square, POLICY.signed_max_square))
    return max(sizes, default=0.0) + freedom


def _alone(c: Candidate, part: TwinPart) -> bool:
    """Whether none of the laws that go with a law is at its place."""
    return not any(
        given.law in MECHANISMS[c.mechanism].goes_with and c.where.name in outlets_of(given)
        for given in part.mechanisms.values()
    )


def _grown(like: Scored, fitted: Fitted) -> float:
    """The ratio of the fitted to the screened amplitude; 1 where that is not known."""
    c, most = like.candidate, POLICY.amplitude_max_growth
    if c.mechanism not in MECHANISMS:
        return 1.0
    for amplitude, off in (MECHANISMS[c.mechanism].off or {}).items():
        name = f"mechanisms.{c.name}.{amplitude}"
        seen = like.amplitudes.get(amplitude, 0.0)
        if seen and any(p.name == name for p in fitted.problem.network.parameters):
            return float(np.clip((fitted.values[fitted.problem.network.index(name)] - off) / seen, 1.0 / most, most))
    return 1.0


def _stated(spec: Spec, c: Candidate) -> Spec:
    """The Spec with the candidate's own value, where a shape was looked for at several."""
    given = c.part.parameters.get(spec.name) if c.part is not None else None
    return spec if given is None else replace(spec, value=convert(given.value, spec.unit))
