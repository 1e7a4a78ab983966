"""Export: IEC 61131-3 structured text, one function block for each axis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import isfinite
from typing import ClassVar

import numpy as np

from compensation.exports.base import AxisModel, Export, Exporter, ascii_text, identifiers
from compensation.exports.lowering import Language, Shape, Writer, lower, number_lines

MOST_NUMBERS = 2000  # constants of one block: 16 kB, which small controllers hold and compile
_TEXT = 120  # characters of a string


class StructuredText(Language):
    """IEC 61131-3."""

    functions: ClassVar[Mapping[str, str]] = {
        "abs": "ABS", "exp": "EXP", "min": "MIN", "max": "MAX", "or": "OR", "less": "<", "equal": "=",
    }  # fmt: skip

    def comment(self, text: str) -> str:
        return f"(* {ascii_text(text)} *)"

    def put(self, target: str, value: str) -> str:
        return f"{target} := {value};"

    def loop(self, index: str, count: int | str, first: int | str = 0) -> tuple[str, str]:
        return f"FOR {index} := {first} TO {int(count) - 1} DO", "END_FOR;"

    def when(self, condition: str) -> tuple[str, str, str]:
        compound = " OR " in condition  # OR binds more loosely than comparisons; brackets show it
        text = " OR ".join(f"({c})" for c in condition.split(" OR ")) if compound else condition
        return f"IF {text} THEN", "ELSE", "END_IF;"

    def repeat(self, left: str, right: str) -> tuple[str, str]:
        return f"WHILE {left} <> {right} DO", "END_WHILE;"

    def number(self, value: float) -> str:
        return real(value) if value >= 0 else f"({real(value)})"

    def choice(self, condition: str, yes: str, no: str) -> str:
        return f"SEL({condition}, {no}, {yes})"

    def power(self, base: str, exponent: float) -> str:
        return f"EXPT({base}, {self.number(exponent)})"

    def call(self, function: str, *args: str) -> str:
        if function == "single":
            return f"REAL_TO_LREAL(LREAL_TO_REAL({args[0]}))"
        return super().call(function, *args)

    def tanh(self, w: Writer, target: str, x: str) -> None:
        """From exp, as the standard has no tanh; exact to rounding and without overflow."""
        t = w.scalar("decay")
        w.put(t, f"EXP(-2.0 * ABS({x}))")
        w.put(t, f"(1.0 - {t}) / (1.0 + {t})")
        with w.when(f"{x} < 0.0"):
            w.put(target, f"-{t}")
        with w.otherwise():
            w.put(target, t)


def real(value: float) -> str:
    """An LREAL literal: it needs a point."""
    mantissa, _, exponent = repr(float(value)).partition("e")
    return f"{mantissa}{'' if '.' in mantissa else '.0'}{f'E{int(exponent)}' if exponent else ''}"


class StructuredTextExport(Exporter):
    """One function block for each axis: the model, and the correction with its limits and fallback."""

    key: ClassVar[str] = "st"
    summary: ClassVar[str] = "IEC 61131-3 structured text: one function block for each axis, with limits and fallback"
    suffix: ClassVar[str] = ".st"

    def refusal(self, export: Export) -> str | None:
        for a in export.axes:
            sizes = {k: sum(v.size for v in n.data.values()) for k, n in enumerate(a.program.nodes)}
            total = sum(sizes.values())
            if total > MOST_NUMBERS:
                most = a.program.nodes[max(sizes, key=lambda k: sizes[k])].op
                return f"axis {a.axis} has {total} constants, most in {most}; a block holds {MOST_NUMBERS}"
        return None

    def files(self, export: Export) -> dict[str, str | bytes]:
        names = identifiers(a.axis for a in export.axes)
        blocks = [_block(export, a, f"FB_{export.stem}_{name}") for a, name in zip(export.axes, names, strict=True)]
        return {f"{export.stem}{self.suffix}": "\n".join(blocks)}


def _block(export: Export, a: AxisModel, name: str) -> str:
    p, w = a.program, Writer(StructuredText(), indent=0)
    names = identifiers(p.channels)
    corrected = _corrected(a)
    _reset(w, a)
    w.put("version", _string(f"{export.model} {export.version}"))
    w.put("sha256", _string(export.digest))
    w.put("simulated", "TRUE" if export.simulated else "FALSE")
    w.put("moved_s", "MAX(elapsed_s, 0.0)")
    w.put("quiet_s", "quiet_s + moved_s")
    w.put("due", f"since_s >= {real(p.step_s)}")
    with w.when("due"):
        w.put("since_s", f"MAX(MIN(since_s - {real(p.step_s)}, {real(p.step_s)}), 0.0)")
        _row(w, a, names)
    w.put("since_s", "since_s + moved_s")
    _correction(w, a)

    if names:
        w.memory |= {"v0": ("real", len(names)), "seen": ("logical", len(names))}
    else:
        w.memory.pop("v0", None)
    declared_in = [
        "elapsed_s : LREAL; (* time since the last call, s *)",
        "reset : BOOL; (* forgets all rows and the correction *)",
    ]
    for n, channel, unit in zip(names, p.channels, p.units, strict=True):
        declared_in += [
            f"in_{n} : LREAL; (* {ascii_text(f'{channel} in {unit}')} *)",
            f"ok_{n} : BOOL := TRUE; (* FALSE where the sensor reports a fault *)",
        ]
    declared_out = [
        "valid : BOOL; (* the last row has an error *)",
        *(f"{output} : LREAL; (* {unit} *)" for output, unit in a.output_units.items()),
        *(f"{output} : LREAL; (* what the control adds *)" for output, _, _ in corrected),
        f"version : STRING[{_TEXT}];",
        f"sha256 : STRING[{_TEXT}];",
        "simulated : BOOL;",
    ]
    variables = [
        f"since_s : LREAL := {real(p.step_s)}; (* since the last row *)",
        "quiet_s : LREAL; (* since the last valid row *)",
        "held_s : LREAL; (* since the fault began *)",
        *(f"{n} : LREAL;" for n in ("moved_s", "reach", *(f"target_{output}" for output, _, _ in corrected))),
        *(f"{n} : BOOL;" for n in ("due", "begun", "first_row", "complete", "lacking", "faulty")),
        *(f"{n} : {_KINDS[kind]};" for n, kind in w.scalars.items()),
        *(f"{n} : {_array(shape)};" for n, shape in w.memory.items()),
    ]
    constants = [line for n, values in w.tables.items() for line in _constant(n, values)]
    parts = [("VAR_INPUT", declared_in), ("VAR_OUTPUT", declared_out), ("VAR", variables), ("VAR CONSTANT", constants)]
    declared = "\n".join(_section(title, lines) for title, lines in parts if lines)
    heading = "\n".join(f"   {line}".rstrip() for line in export.heading([a]))
    body = "\n".join(w.lines)
    return f"""(*
{heading}

   Call this in every cycle with the time since the last call: it runs the model every {p.step_s:g} s and moves the
   outputs at most as far as the limits allow. The first row, at the start and after a reset, is that at which every
   input has been seen.
*)
FUNCTION_BLOCK {name}
{declared}

{body}
END_FUNCTION_BLOCK
"""


def _reset(w: Writer, a: AxisModel) -> None:
    with w.when("reset"):
        w.put("since_s", real(a.program.step_s))
        w.put("quiet_s", "0.0")
        for variable in ("begun", "valid", "faulty", *(f"seen[{k}]" for k in range(len(a.program.channels)))):
            w.put(variable, "FALSE")
        for output, _, _ in _corrected(a):
            w.put(output, "0.0")
            w.put(f"target_{output}", "0.0")


def _row(w: Writer, a: AxisModel, names: Sequence[str]) -> None:
    """One row of the model, and the target of the correction."""
    w.comment("one row of the model; an input that is not usable is missing")
    w.put("lacking", "FALSE")
    w.put("complete", "TRUE")
    for k, (n, required, usable) in enumerate(zip(names, a.program.required, a.usable(), strict=True)):
        low, high = (real(min(max(end, -1e300), 1e300)) for end in usable)
        with w.when(f"ok_{n} AND (in_{n} >= {low}) AND (in_{n} <= {high})"):
            w.put(f"v0[{k}]", f"in_{n}")
            w.put(f"seen[{k}]", "TRUE")
        if required:
            with w.otherwise():
                w.put("lacking", "TRUE")
        w.put("complete", f"complete AND seen[{k}]")
    w.put("valid", "complete AND NOT lacking")
    with w.when("complete"):
        w.put("first_row", "NOT begun")
        w.put("begun", "TRUE")
        for output, value in zip(a.output_units, lower(w, a.program), strict=True):
            w.put(output, value("0"))
    with w.when("valid"):
        w.put("quiet_s", "0.0")
        for (output, factor, (largest, _, _)), error in zip(_corrected(a), a.output_units, strict=True):
            w.put(f"target_{output}", f"MIN(MAX({real(factor)} * {error}, {real(-largest)}), {real(largest)})")


def _correction(w: Writer, a: AxisModel) -> None:
    """Moves the outputs towards their targets; without valid rows they are held, then fade to 0."""
    w.comment("correction: limited in size and rate; held, then faded to 0, without valid rows")
    with w.when(f"quiet_s > {real(a.stale_s)}"):
        w.put("valid", "FALSE")
    with w.when("faulty"):
        w.put("held_s", "held_s + moved_s")
    with w.otherwise():
        w.put("held_s", "0.0")
    w.put("faulty", "NOT valid")
    with w.when("faulty"):
        with w.when(f"held_s > {real(a.limits.hold_s)}"):
            for output, _, _ in _corrected(a):
                w.put(f"target_{output}", "0.0")
        with w.otherwise():
            for output, _, _ in _corrected(a):
                w.put(f"target_{output}", output)
    for output, _, (_, rate, step) in _corrected(a):
        w.put("reach", f"MIN({real(rate)} * MIN(moved_s, {real(a.stale_s)}), {real(step)})")
        w.put(output, f"{output} + MIN(MAX(target_{output} - {output}, -reach), reach)")


_KINDS: Mapping[str, str] = {"real": "LREAL", "whole": "DINT", "logical": "BOOL"}


def _array(shape: Shape) -> str:
    kind, size = shape
    return f"ARRAY[0..{size - 1}] OF {_KINDS[kind]}" if size else _KINDS[kind]


def _constant(name: str, values: np.ndarray) -> list[str]:
    kind = "DINT" if np.issubdtype(values.dtype, np.integer) else "LREAL"
    numbers = number_lines(values, real)
    head = f"{name} : ARRAY[0..{len(values) - 1}] OF {kind} := ["
    return [f"{head}{numbers[0]}];"] if len(numbers) == 1 else [head, *(f"    {n}" for n in numbers), "];"]


def _section(title: str, lines: Sequence[str]) -> str:
    return "\n".join([title, *(f"    {line}" for line in lines), "END_VAR"])


def _string(text: str) -> str:
    plain = ascii_text(text)[:_TEXT].replace("$", "$$").replace("'", "$'")
    return f"'{plain}'"


def _corrected(a: AxisModel) -> list[tuple[str, float, tuple[float, float, float]]]:
    """Outputs of the correction with their factor to the model's, and largest value, rate and change."""
    step = a.step_um if isfinite(a.step_um) else 1e30
    kept = (float(a.limits.max_offset_um), float(a.limits.rate_um_per_s), float(step))
    out = [("offset_um", -1.0, kept)]
    if a.program.along:
        largest, rate, change = (value / a.lever_m for value in kept)
        out.append(("slope_um_per_m", -1000.0, (largest, rate, change)))
    return out
