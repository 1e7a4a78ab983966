"""Quantities: values with units, priors and bounds, as a machine file writes them and as a fit moves them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, model_validator

from data.arrays import Array
from data.units import pint_name, unit_registry

Scale = Literal["log", "linear", "logit"]


@lru_cache(maxsize=4096)
def convert(text: str | float, unit: str) -> float:
    """The number in `unit` that "14 W/K", "6.6 kJ/K", "20 degC" or a bare number (already in `unit`) means.

    Raises:
        ValueError: no number, an unknown unit, or one of another dimension; the message says got, expected, example.
    """
    if isinstance(text, int | float):
        return _finite(float(text), text, unit)
    number, _, given = text.strip().partition(" ")
    try:
        value = float(number)
    except ValueError:
        raise ValueError(f"expected a number with a unit such as '1 {unit}', got {text!r}") from None
    _finite(value, text, unit)
    given = given.strip()
    if not given or given == unit:
        return value
    temperature = unit == "degC" and given in ("degF", "K")  # a difference of two is in K
    if {"degC", "degF"} & {unit, given} and not temperature:
        raise ValueError(f"unit {given!r} cannot be read as {unit!r}; write e.g. '1 {unit}'")
    try:
        return float(unit_registry().Quantity(value, pint_name(given)).to(pint_name(unit)).magnitude)
    except Exception as error:  # pint has no common base for its many parsing errors
        raise ValueError(
            f"unit {given!r} cannot be read as {unit!r} ({_first_line(error)}); write e.g. '1 {unit}'"
        ) from None


@lru_cache(maxsize=4096)
def same_dimension(one: str, other: str) -> bool:
    """Whether two units measure the same kind of thing; rpm counts as 1/s, % as a number."""
    registry = unit_registry()
    dimension = [registry.Unit(pint_name("K" if u == "degC" else u)).dimensionality for u in (one, other)]
    return bool(dimension[0] == dimension[1])


def _finite(value: float, text: object, unit: str) -> float:
    if not math.isfinite(value):
        raise ValueError(f"expected a finite number such as '1 {unit}', got {text!r}")
    return value


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__


class Value(BaseModel):
    """A parameter in a machine file: "14 W/K" (fixed) or a mapping with a prior (free).

    `spread` is the prior's standard deviation: of the logarithm for positive parameters (0.5 is about a factor 1.6),
    of the value itself, with a unit, for signed ones. A spread frees the parameter; `free: false` holds it all the
    same. `bounds` in the parameter's unit. `per_batch`, on the size of a heat, is how much it differs from run to run:
    the sd of its logarithm; each batch of a calibration has a deviation of its own, a prediction none. A calibrated
    file keeps the prior's centre in `prior` and says how sure the value is in `interval90`.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    value: str | float
    spread: str | float | None = None
    bounds: tuple[str | float, str | float] | None = None
    free: bool | None = None
    per_batch: str | float | None = None
    prior: str | float | None = None
    interval90: tuple[str | float, str | float] | None = None
    source: str = ""

    @model_validator(mode="before")
    @classmethod
    def _short(cls, raw: Any) -> Any:
        return {"value": raw} if isinstance(raw, str | int | float) and not isinstance(raw, bool) else raw


@dataclass(frozen=True)
class Spec:
    """Definition of a parameter, wherever it is used: unit, meaning, usual value and prior, bounds, sign.

    `scale` says in which coordinate it is fitted: log (positive), linear (signed), logit (a share between 0 and 1).
    `spread` is the prior's sd in that coordinate and, like `value`, the default where a machine file gives none. `per`
    names the law's driver in whose own unit it counts: `unit` is then that of one unit of the driver.
    """

    name: str
    unit: str
    words: str
    value: float | None = None
    spread: float | None = None
    low: float = -math.inf
    high: float = math.inf
    scale: Scale = "log"
    per: str = ""


@dataclass(frozen=True)
class Parameter:
    """One parameter of a compiled network: `name` is its path in the twin part, value and bounds in `unit`."""

    name: str
    unit: str
    words: str
    value: float
    spread: float  # in fitting coordinates; nan where the parameter is fixed without a prior
    low: float
    high: float
    scale: Scale
    free: bool
    source: str = ""
    prior: float = math.nan  # the prior's centre, in `unit`; nan: the value
    per_batch: float = 0.0  # sd of each batch's own deviation in fitting coordinates; 0: none

    @property
    def prior_value(self) -> float:
        """The prior's centre in `unit`."""
        return self.prior if math.isfinite(self.prior) else self.value

    def to_x(self, value: Any) -> Any:
        """Fitting coordinate of a value in `unit`."""
        v = np.asarray(value)
        if self.scale == "log":
            return np.log(v)
        return np.log(v / (1 - v)) if self.scale == "logit" else v

    def from_x(self, x: Any) -> Any:
        """The inverse of `to_x`."""
        x = np.asarray(x)
        if self.scale == "log":
            return np.exp(x)
        return 1 / (1 + np.exp(-x)) if self.scale == "logit" else x

    def slope(self, value: Any) -> Any:
        """d value / d x at a value."""
        v = np.asarray(value)
        if self.scale == "log":
            return v
        return v * (1 - v) if self.scale == "logit" else np.ones_like(v)


def parameter(path: str, spec: Spec, given: Value | None, default_source: str = "") -> Parameter:
    """The parameter that a machine file's value and the meaning of its place make together.

    Raises:
        ValueError: missing value or prior, wrong unit, not finite, out of bounds; the message starts with the path.
    """
    low, high = spec.low, spec.high
    if spec.scale != "linear":
        low = max(low, 0.0)
    if spec.scale == "logit":
        high = min(high, 1.0)
    if given is None:
        if spec.value is None:
            raise ValueError(f"{path} is missing; expected {spec.words} in {spec.unit}, e.g. '1 {spec.unit}'")
        return Parameter(
            path, spec.unit, spec.words, spec.value, math.nan, low, high, spec.scale, False, default_source
        )
    try:
        value = convert(given.value, spec.unit)
        prior = math.nan if given.prior is None else convert(given.prior, spec.unit)
        if given.bounds is not None:
            low, high = (convert(b, spec.unit) for b in given.bounds)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    if spec.scale != "linear" and value <= 0 and not (spec.scale == "log" and value == 0 and given.spread is None):
        raise ValueError(f"{path}: got {given.value!r}, expected {spec.words} above 0 {spec.unit}")
    if spec.scale == "logit" and value >= 1 and given.spread is not None:
        raise ValueError(f"{path}: got {given.value!r}, expected a share below 1")
    if not low <= value <= high:
        raise ValueError(
            f"{path}: {value:g} {spec.unit} lies outside the bounds {low:g} to {high:g}; widen them or correct it"
        )
    spread = _deviation(path, "spread", spec, given.spread)
    free = given.free if given.free is not None else math.isfinite(spread)
    if free and not math.isfinite(spread):
        raise ValueError(f"{path} is free but has no prior; add 'spread', e.g. spread: {spec.spread or 0.5}")
    per_batch = _deviation(path, "per_batch", spec, given.per_batch)
    return Parameter(
        path, spec.unit, spec.words, value, spread, low, high, spec.scale, free, given.source, prior,
        per_batch if math.isfinite(per_batch) else 0.0,
    )  # fmt: skip


def _deviation(path: str, key: str, spec: Spec, given: str | float | None) -> float:
    """A standard deviation in the fitting coordinate; nan where none is given."""
    if given is None:
        return math.nan
    try:
        if spec.scale == "linear":
            delta = "K" if spec.unit == "degC" else spec.unit
            out = convert(given, delta)
        else:
            out = convert(given, "1")
    except ValueError as error:
        raise ValueError(f"{path}.{key}: {error}") from None
    if out <= 0:
        raise ValueError(f"{path}.{key}: got {given!r}, expected a number above 0 (or leave it out)")
    return out


@dataclass(frozen=True)
class Monomial:
    """``const * prod(theta_j ** e_j)`` over parameters: what every capacity, conductance and lever arm is."""

    const: float
    powers: tuple[tuple[int, float], ...] = ()

    def times(self, const: float) -> Monomial:
        return Monomial(self.const * const, self.powers)

    def __call__(self, values: Array) -> Array:
        """At parameter values (..., n), shape (...)."""
        out = np.full(values.shape[:-1], self.const)
        for j, e in self.powers:
            out = out * values[..., j] ** e
        return out

    def slope(self, values: Array, j: int) -> Array:
        """Derivative by parameter j's value at values (..., n), shape (...)."""
        out = np.zeros(values.shape[:-1])
        for k, e in self.powers:
            if k == j:
                rest = Monomial(self.const * e, tuple(p for p in self.powers if p != (k, e)))
                out = out + rest(values) * values[..., k] ** (e - 1)
        return out


def values_of(parameters: Sequence[Parameter]) -> Array:
    """The parameters' values (n,), in their units."""
    return np.array([p.value for p in parameters], dtype=np.float64)
