"""Straight lines for controls: K0(T) and tan β(T) as formulas of the present values and those of the first row.

Controls evaluate ΔK(P) = K0 + tan β · (P − P0); K0 and tan β come from the PLC. It can compute sums of temperatures,
but no operation with carried state other than a value kept from the start.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf
from typing import ClassVar

import numpy as np

from compensation.exports.base import AxisModel, Export, Exporter, identifiers, wrapped
from data.arrays import Array
from data.errors import WorkError
from models.program import Program, replay

NOT_TESTED = (
    "This file is in the style of the control's data. It has not been run on a control: compare every identifier with "
    "the manual of your control, and the sign with a trial value of 10 um, before you use it."
)
_LINEAR = {"input", "constant", "join", "pick", "affine", "sub", "mul", "first"}
_CHECKED_ROWS, _LARGEST_ROUNDING = 20, 1e-9


@dataclass(frozen=True)
class Formula:
    """A value = constant + now · x + first · x(first row), over the program's channels x (m,)."""

    channels: tuple[str, ...]
    constant: float
    now: Array
    first: Array

    def value(self, now: Array, first: Array) -> float:
        return float(self.constant + self.now @ now + self.first @ first)

    def bounds(self, axis: AxisModel) -> tuple[float, float] | None:
        """Least and greatest value over the trained region; None where a channel that counts has none.

        The first row lies anywhere in the region too.
        """
        low = high = self.constant
        for name, *coefficients in zip(self.channels, self.now, self.first, strict=True):
            for c in coefficients:
                if c == 0.0:
                    continue
                if name not in axis.region:
                    return None
                ends = [float(c) * end for end in axis.region[name]]
                low, high = low + min(ends), high + max(ends)
        return low, high

    def text(self, names: Sequence[str], factor: float = 1.0) -> str:
        """As an expression; a rise since the first row is a difference."""
        terms = []
        for name, now, first in zip(names, self.now * factor, self.first * factor, strict=True):
            if now and abs(now + first) <= _LARGEST_ROUNDING * abs(now):
                terms.append(f"{_signed(now)} * ({name} - {name}_first)")
                continue
            terms += [f"{_signed(now)} * {name}"] if now else []
            terms += [f"{_signed(first)} * {name}_first"] if first else []
        head = [f"{self.constant * factor:.9g}"] if self.constant or not terms else []
        return " ".join([*head, *terms]).removeprefix("+ ")


def _signed(value: float) -> str:
    return f"{'-' if value < 0 else '+'} {abs(value):.9g}"


class StraightLineExport(Exporter):
    """Base of the exports for controls that evaluate a straight line."""

    slope: ClassVar[bool] = True  # the control adds a part along the axis

    def refusal(self, export: Export) -> str | None:
        for a in export.axes:
            dynamic = dynamic_operations(a.program)
            if dynamic:
                return (
                    f"axis {a.axis} uses {', '.join(dynamic)}, and the control evaluates only sums of present "
                    "temperatures (`thermodrift compensate` can write K0 and tan beta cyclically instead)"
                )
            if a.program.along and not self.slope:
                return f"axis {a.axis} has a slope along {a.program.along}, and the control adds one offset for an axis"
        return None


def dynamic_operations(program: Program) -> list[str]:
    """Operations that are no sum of present and first values, in their order; empty where the program is one."""
    fixed: set[int] = set()
    out = []
    for k, n in enumerate(program.nodes):
        constant = n.op != "input" and all(a in fixed for a in n.args) and n.op in _LINEAR
        fixed |= {k} if constant else set()
        if n.op not in _LINEAR or (n.op == "mul" and not any(a in fixed for a in n.args)):
            out.append(n.op if n.op != "mul" else "mul of two inputs")
    return list(dict.fromkeys(out))


def formulas(axis: AxisModel) -> list[Formula]:
    """One for each output, from the program itself: two rows, each channel at 0 or 1 in either of them.

    Raises:
        WorkError: random rows of the trained region give something else, so that the program is no straight line.
    """
    p, width = axis.program, len(axis.program.channels)

    def ends(first: Array, now: Array) -> Array:
        return replay(p, np.stack([first, now]))[1]

    zero, one = np.zeros(width), np.eye(width)
    base = ends(zero, zero)
    now = np.array([ends(zero, e) - base for e in one]).reshape(width, len(base))
    first = np.array([ends(e, zero) - base for e in one]).reshape(width, len(base))
    out = [Formula(p.channels, float(base[o]), now[:, o], first[:, o]) for o in range(len(base))]
    rng = np.random.default_rng(0)
    low, high = np.array([axis.region.get(c, (0.0, 100.0)) for c in p.channels]).reshape(-1, 2).T
    for _ in range(_CHECKED_ROWS):
        a, b = rng.uniform(low, high), rng.uniform(low, high)
        got = np.array([f.value(b, a) for f in out])
        size = np.array([abs(f.constant) + np.abs(f.now) @ np.abs(b) + np.abs(f.first) @ np.abs(a) for f in out])
        if (np.abs(got - ends(a, b)) > _LARGEST_ROUNDING * (1.0 + size)).any():
            raise WorkError(f"axis {axis.axis}: the model is no sum of its inputs; export it as c, st, onnx or json")
    return out


def warnings(axis: AxisModel, lines: Sequence[Formula], most_um: float = inf, limit_name: str = "") -> list[str]:
    """Lines that state where K0 or tan β can leave its range in the trained region; `limit_name`: the control's."""
    offset_um = (most_um, limit_name, ""), (axis.limits.max_offset_um, "max_offset_um", "; it is cut there")
    slope = ((axis.max_slope_um_per_m, "its limit", "; it is cut there"),)
    quantities = (("offset", "um", 1.0, offset_um), ("slope", "um/m", 1000.0, slope))
    out = []
    for formula, (name, unit, factor, limits) in zip(lines, quantities, strict=False):
        bounds = formula.bounds(axis)
        if bounds is None:
            out.append(f"WARNING: axis {axis.axis}: the range of the {name} is unknown; an input has no trained region")
            continue
        largest = factor * max(abs(b) for b in bounds)
        for most, which, then in limits:
            if largest > most:
                reach = f"the {name} can reach {largest:.6g} {unit} in the trained region"
                out.append(f"WARNING: axis {axis.axis}: {reach}, beyond {which} of {most:g} {unit}{then}")
    return out


def input_names(axis: AxisModel) -> list[str]:
    """Names of the channels in formulas."""
    return identifiers(axis.program.channels)


def formula_lines(axis: AxisModel) -> list[str]:
    """The formulas of an axis as comment lines."""
    names, lines = input_names(axis), []
    for f, (name, unit) in zip(formulas(axis), axis.output_units.items(), strict=True):
        lines.append(f"{name} = {f.text(names)}   in {unit}")
    for name, channel, unit in zip(names, axis.program.channels, axis.program.units, strict=True):
        lines.append(f"  {name}: {channel} in {unit}; {name}_first: its value in the first row")
    return lines


def plc_lines(axis: AxisModel, rate_um_per_s: float, writes: Sequence[str]) -> list[str]:
    """Pseudo code that a PLC runs cyclically: formulas, limits, fallback, and what it writes.

    `writes` are its last lines; they may use ``offset_um`` and ``slope_um_per_m``.
    """
    names, p = input_names(axis), axis.program
    needed = [n for n, required in zip(names, p.required, strict=True) if required]
    usable = [
        f"{n} >= {low:.6g} AND {n} <= {high:.6g}"
        for n, channel, (low, high) in zip(names, p.channels, axis.usable(), strict=True)
        if channel in axis.region
    ]
    text = formulas(axis)
    wanted = [("offset_um", text[0].text(names, -1.0), axis.limits.max_offset_um, rate_um_per_s)]
    if p.along:
        slope_rate = rate_um_per_s / axis.lever_m
        wanted.append(("slope_um_per_m", text[1].text(names, -1000.0), axis.max_slope_um_per_m, slope_rate))
    lines = [
        f"IF start THEN {' '.join(f'{n}_first := {n};' for n in names)} END_IF",
        f"valid := all of ({', '.join(needed) or 'no input'}) are read without a fault",
        *(f"  AND {condition}" for condition in usable),
        f"  AND read within the last {axis.stale_s:g} s",
        "IF valid THEN fault_s := 0; ELSE fault_s := fault_s + cycle_s; END_IF",
    ]
    for name, formula, largest, rate in wanted:
        lines += [
            f"IF valid THEN target_{name} := LIMIT({-largest:.6g}, {formula}, {largest:.6g});",
            f"ELSIF fault_s <= {axis.limits.hold_s:g} THEN target_{name} := {name};  // hold",
            f"ELSE target_{name} := 0; END_IF  // fade out at the limited rate",
            f"{name} := {name} + LIMIT({-rate:.6g} * cycle_s, target_{name} - {name}, {rate:.6g} * cycle_s)",
        ]
    return [*lines, *writes]


def commented(lines: Sequence[str], mark: str) -> str:
    """Lines as comments, each wrapped at 110 characters."""
    return "\n".join(f"{mark} {line}".rstrip() for line in wrapped(lines))
