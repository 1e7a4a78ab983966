"""Export: IEC 61131-3 structured text, one function block for each axis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np

from compensation.core import INPUTS
from compensation.exports.base import MOST, Export, ExportedAxis, Exporter, ascii_text, identifiers, stale_rows, wrapped
from compensation.exports.lowering import Language, Shape, Writer, lower, lower_core, lower_over, number_lines

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
        return stale_rows(export)

    def files(self, export: Export) -> dict[str, str | bytes]:
        names = identifiers(a.axis for a in export.axes)
        blocks = [_block(export, a, f"FB_{export.stem}_{name}") for a, name in zip(export.axes, names, strict=True)]
        return {f"{export.stem}{self.suffix}": "\n".join(blocks)}


def _block(export: Export, a: ExportedAxis, name: str) -> str:
    p, w = a.program, Writer(StructuredText(), indent=0)
    names = identifiers(p.channels)
    with w.when("reset"):
        w.put("since_s", real(p.step_s))
        for variable in ("begun", "valid", *(f"seen[{k}]" for k in range(len(p.channels)))):
            w.put(variable, "FALSE")
    w.put("version", _string(f"{export.model} {export.version}"))
    w.put("sha256", _string(export.digest))
    w.put("simulated", "TRUE" if export.simulated else "FALSE")
    for event in ("usable", "faulty"):
        w.put(event, "0.0")
    w.put("due", f"fresh AND (since_s >= {real(p.step_s)})")
    with w.when("due"):
        w.put("since_s", f"MAX(MIN(since_s - {real(p.step_s)}, {real(p.step_s)}), 0.0)")
        _row(w, a, names)
    w.put("since_s", "since_s + moved_s")
    move(w, a)

    w.memory.pop("v0", None)
    if names:
        w.memory |= {"v0": ("real", len(names)), "seen": ("logical", len(names))}
    declared_in = [
        *MOVED,
        "reset : BOOL; (* forgets all rows; what is sent goes on from where it is *)",
        "fresh : BOOL := TRUE; (* FALSE while the inputs below are not renewed *)",
    ]
    for n, channel, unit in zip(names, p.channels, p.units, strict=True):
        declared_in += [
            f"in_{n} : LREAL; (* {ascii_text(f'{channel} in {unit}')} *)",
            f"ok_{n} : BOOL := TRUE; (* FALSE where the sensor reports a fault *)",
        ]
    declared_out = [
        "valid : BOOL; (* the last row has an error *)",
        *(f"{output} : LREAL; (* {unit} *)" for output, unit in a.output_units.items()),
        *sent_outputs(a),
        f"version : STRING[{_TEXT}];",
        f"sha256 : STRING[{_TEXT}];",
        "simulated : BOOL;",
    ]
    variables = [
        f"since_s : LREAL := {real(p.step_s)}; (* since the last row *)",
        "trust : LREAL;",
        *(f"{n} : BOOL;" for n in ("due", "begun", "complete", "lacking")),
    ]
    return function_block(name, w, declared_in, declared_out, variables, [
        *export.heading([a]), "",
        "Call this in every cycle with the time since the last call: it runs the model every "
        f"{p.step_s:g} s and moves the outputs at most as far as the limits allow. The first row, at the start and "
        "after a reset, is that at which every input has been seen.",
    ])  # fmt: skip


MOVED = (
    "elapsed_s : LREAL; (* time since the last call, s *)",
    "enable : BOOL := TRUE; (* FALSE: the outputs fade to 0 and stay there *)",
)


def sent_outputs(a: ExportedAxis) -> list[str]:
    """Declarations of what the control adds."""
    return [
        "state : DINT; (* 0 off, 1 warm-up, 2 active, 3 hold, 4 fade-out *)",
        *(f"{output} : LREAL; (* {unit}, what the control adds *)" for output, unit, _ in a.sent),
    ]


def move(w: Writer, a: ExportedAxis) -> None:
    """Moves what is sent towards `wanted_um`, as `usable` and `faulty` of this call say."""
    w.comment("what is sent, within the limits of size, rate and step; held, then faded to 0, without usable input")
    count = len(a.sent)
    w.put("first_row", "NOT core_begun")
    w.put("core_begun", "TRUE")
    w.put("stopped", "SEL(enable, 1.0, 0.0)")
    wanted = [f"{w.array('wanted_um', count)}[{k}]" for k in range(count)]
    events = {name: [name] * count for name in ("usable", "faulty", "stopped")}
    state, now_um, *_ = lower_core(
        w, {**events, "elapsed_s": ["moved_s"] * count, "wanted_um": wanted}, [a.limits] * count
    )
    w.memory["core_v0"] = ("real", len(INPUTS) * count)
    for (output, _, um), value in zip(a.sent, now_um, strict=True):
        w.put(output, value if um == 1.0 else f"{value} / {real(um)}")
    w.put("state", f"LREAL_TO_DINT({state[0]})")


def function_block(
    name: str, w: Writer, given: Sequence[str], sent: Sequence[str], own: Sequence[str], heading: Sequence[str]
) -> str:
    """The block of what a writer holds, with declarations and a comment of its own."""
    variables = [
        *own,
        *(f"{n} : LREAL;" for n in ("moved_s", "last_s", "usable", "faulty", "stopped")),
        *(f"{n} : BOOL;" for n in ("first_row", "core_begun")),
        *(f"{n} : {_KINDS[kind]};" for n, kind in w.scalars.items()),
        *(f"{n} : {_array(shape)};" for n, shape in w.memory.items()),
    ]
    constants = [line for n, values in w.tables.items() for line in _constant(n, values)]
    parts = [("VAR_INPUT", given), ("VAR_OUTPUT", sent), ("VAR", variables), ("VAR CONSTANT", constants)]
    declared = "\n".join(_section(title, lines) for title, lines in parts if lines)
    comment, body = "\n".join(f"   {line}".rstrip() for line in wrapped(heading)), "\n".join(w.lines)
    moved = f"""IF (elapsed_s > 0.0) AND (elapsed_s <= {real(1e300)}) THEN
    last_s := elapsed_s;
END_IF;
moved_s := SEL(elapsed_s <= 0.0, last_s, 0.0); (* an elapsed time that is no number counts as the one before *)"""
    return f"""(*
{comment}
*)
FUNCTION_BLOCK {name}
{declared}

{moved}
{body}
END_FUNCTION_BLOCK
"""


def within(x: str, low: float, high: float) -> str:
    """A condition that NaN and infinity do not meet."""
    low, high = max(low, -1e300), min(high, 1e300)
    return f"({x} >= {real(low)}) AND ({x} <= {real(high)})"


def _row(w: Writer, a: ExportedAxis, names: Sequence[str]) -> None:
    """One row of the model, and what it wants to be sent."""
    w.comment("one row of the model; an input that is not usable is missing")
    w.put("lacking", "FALSE")
    w.put("complete", "TRUE")
    for k, (n, required, usable) in enumerate(zip(names, a.program.required, a.usable(), strict=True)):
        with w.when(f"ok_{n} AND {within(f'in_{n}', *usable)}"):
            w.put(f"v0[{k}]", f"in_{n}")
            w.put(f"seen[{k}]", "TRUE")
        if required:
            with w.otherwise():
                w.put("lacking", "TRUE")
        w.put("complete", f"complete AND seen[{k}]")
    w.put("trust", "1.0")
    with w.when("complete"):
        w.put("first_row", "NOT begun")
        w.put("begun", "TRUE")
        if a.checks is not None:
            w.put("lacking", f"lacking OR ({lower_over(w, a.checks, 'checks_', a.program.channels)} > 0.5)")
        for output, (value,) in zip(a.output_units, lower(w, a.program), strict=True):
            w.put(output, value)
        if a.trust is not None:
            w.put("trust", lower_over(w, a.trust, "trust_", a.program.channels))
    finite = (within(output, -MOST, MOST) for output in a.output_units)
    w.put("valid", " AND ".join(["complete", "NOT lacking", *finite]))
    with w.when("valid"):
        w.put("usable", "1.0")
        for k, ((_, unit, um), error) in enumerate(zip(a.sent, a.output_units, strict=True)):
            scale = -um * (1000.0 if unit != "um" else 1.0)  # the model's outputs are um and um/mm
            w.put(f"{w.array('wanted_um', len(a.sent))}[{k}]", f"({real(scale)}) * {error} * trust")
    with w.otherwise():
        w.put("faulty", "1.0")


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
