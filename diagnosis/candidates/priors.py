"""What is plausible of a candidate before the recordings are asked: the size of its amplitude, where its fit begins."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from diagnosis.candidates.library import outlets_of
from diagnosis.contracts import Candidate, Fitted, Scored
from twin.mechanisms import MECHANISMS
from twin.quantity import Spec, Value, convert, same_dimension
from twin.schema import TwinPart

TYPICAL_W_PER_K = 20.0  # a link or an exposure of a machine tool's body
SAME = 10.0  # within this factor it is one: priors are wider
GROW = ("W", "W/K", "m**2")  # units of what goes with the size


def size_of(fitted: Fitted) -> float:
    """Geometric mean of the fitted conductances over a machine tool's; 1 where that is within a factor of `SAME`."""
    network = fitted.problem.network
    conductances = np.array([float(e.conductance(fitted.values)) for e in network.edges])
    known = conductances[conductances > 0]
    if not len(known):
        return 1.0
    ratio = float(np.exp(np.mean(np.log(known)))) / TYPICAL_W_PER_K
    return 1.0 if 1.0 / SAME < ratio < SAME else ratio


def at_size(spec: Spec, size: float) -> Spec:
    """The Spec with the usual value of a machine of that size."""
    if size == 1.0 or spec.scale != "log" or not spec.value or not any(same_dimension(spec.unit, u) for u in GROW):
        return spec
    return replace(spec, value=float(np.clip(spec.value * size, spec.low, spec.high)))


WIDE = 1.5  # least spread of an amplitude's logarithm: machines differ by more than their handbook values
FREEDOM = 2.0  # nats of each parameter that shapes an effect beside its size
ALONE = 3.0  # nats of a law whose companion is not at its place
LEAST = 1e-3  # of the usual value: where a fit of a positive amplitude begins at the lowest


def start_values(s: Scored, now: Fitted) -> tuple[Mapping[str, Value], Mapping[str, float]]:
    """A candidate's free values with priors, and parameter values by network name where its fit begins.

    The prior's centre is the usual value, its spread wide; the fit begins at the amplitude that the screen found.
    """
    c = s.candidate
    if c.change is not None:
        name = c.change.parameter.name
        value = c.change.parameter.value
        factor = float(np.exp(np.clip(s.amplitudes.get("factor", 0.0), -2.0, 2.0)))
        p = c.change.parameter
        return {}, {name: float(np.clip(value * factor, p.low, p.high))} if c.change.spread else {}
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
        if "expand" in mechanism.effects():  # it stands elsewhere in the network, under another name
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


def _free(spec: Spec, off: float, begin: float) -> tuple[Value, float]:
    if spec.scale == "linear":
        spread = max(3.0 * (1.0 if spec.spread is None else spec.spread), 2.0 * abs(begin - off)) or 1.0
        low, high = spec.low, spec.high
        begin = float(np.clip(begin, low, high))
        return Value(value=_said(off, spec.unit), spread=_said(spread, _delta(spec)), bounds=_bounds(spec)), begin
    usual = spec.value or 1.0
    if spec.scale == "logit":
        begin = float(np.clip(begin, 0.005, 0.995))
        usual = float(np.clip(usual, 0.005, 0.995))
        return Value(value=_said(usual, spec.unit), spread=max(WIDE, spec.spread or 0.0), bounds=_bounds(spec)), begin
    low = max(spec.low, LEAST * usual)
    begin = float(np.clip(begin, max(low, LEAST * usual), spec.high))
    spread = max(WIDE, spec.spread or 0.0, abs(float(np.log(begin / usual))) / 2.0)
    return Value(value=_said(usual, spec.unit), spread=spread, bounds=_bounds(spec)), begin


def _spread(spec: Spec) -> str | float:
    spread = spec.spread if spec.spread is not None else 0.5
    return _said(spread, _delta(spec)) if spec.scale == "linear" else spread


def _delta(spec: Spec) -> str:
    return "K" if spec.unit == "degC" else spec.unit


def _said(value: float | None, unit: str) -> str | float:
    """As a machine file writes it."""
    number = float(f"{value or 0.0:.5g}")
    return number if unit == "1" else f"{number:g} {unit}"


def _bounds(spec: Spec) -> tuple[str | float, str | float] | None:
    if not (np.isfinite(spec.low) and np.isfinite(spec.high)):
        return None
    return _said(spec.low, spec.unit), _said(spec.high, spec.unit)


def log_prior(s: Scored, fitted: Fitted | None, like: Scored | None = None) -> float:
    """Log density of an effect's size about the usual one, 0 at best; signed amplitudes by their usual spread. Of
    several amplitudes the likeliest: they are parts of one effect, and any may be none.

    Where `fitted` holds one that looks `like` this instead, the screen's amplitude grows as that one's did in its fit.
    What has more freedom costs more: a pump that always runs is a cabinet (a nat for each decade of a sample, Schwarz
    1978).
    """
    c = s.candidate
    if c.mechanism not in MECHANISMS:
        return 0.0
    mechanism = MECHANISMS[c.mechanism]
    freedom = -FREEDOM * len(c.shape)
    if fitted is not None and mechanism.goes_with and _alone(c, fitted.part):
        freedom -= ALONE
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
            sizes.append(-0.5 * (float(np.log(value / spec.value)) / max(WIDE, spec.spread or 0.0)) ** 2)
        elif spec.scale == "linear" and spec.spread:
            sizes.append(-0.5 * min(((value - off) / (5.0 * spec.spread)) ** 2, 50.0))
    return max(sizes, default=0.0) + freedom


def _alone(c: Candidate, part: TwinPart) -> bool:
    """Whether a law stands where none is that goes with it."""
    return not any(
        given.law in MECHANISMS[c.mechanism].goes_with and c.where.name in outlets_of(given)
        for given in part.mechanisms.values()
    )


def _grown(like: Scored, fitted: Fitted) -> float:
    """What its fit made of the screen's amplitude, a factor; 1 where that is not known."""
    c = like.candidate
    if c.mechanism not in MECHANISMS:
        return 1.0
    for amplitude, off in (MECHANISMS[c.mechanism].off or {}).items():
        name = f"mechanisms.{c.name}.{amplitude}"
        seen = like.amplitudes.get(amplitude, 0.0)
        if seen and any(p.name == name for p in fitted.problem.network.parameters):
            return float(np.clip((fitted.values[fitted.problem.network.index(name)] - off) / seen, 0.01, 100.0))
    return 1.0


def _stated(spec: Spec, c: Candidate) -> Spec:
    """The Spec with the candidate's own value, where a shape was looked for at several."""
    given = c.part.parameters.get(spec.name) if c.part is not None else None
    return spec if given is None else replace(spec, value=convert(given.value, spec.unit))
