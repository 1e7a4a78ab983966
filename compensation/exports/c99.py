"""Export: C99 source and header with static state, without dependencies beyond math.h."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from math import isfinite
from typing import ClassVar

import numpy as np

from compensation.exports.base import AxisModel, Export, Exporter, ascii_text, identifiers
from compensation.exports.lowering import Language, Writer, lower, number_lines


class C(Language):
    """C99."""

    functions: ClassVar[Mapping[str, str]] = {
        "abs": "fabs",
        "exp": "exp",
        "min": "fmin",
        "max": "fmax",
        "single": "(double)(float)",
        "tanh": "tanh",
        "or": "||",
        "less": "<",
        "equal": "==",
    }

    def comment(self, text: str) -> str:
        return f"/* {ascii_text(text)} */"

    def put(self, target: str, value: str) -> str:
        return f"{target} = {value};"

    def loop(self, index: str, count: int | str, first: int | str = 0) -> tuple[str, str]:
        return f"for ({index} = {first}; {index} < {count}; {index}++) {{", "}"

    def when(self, condition: str) -> tuple[str, str, str]:
        return f"if ({condition}) {{", "} else {", "}"

    def repeat(self, left: str, right: str) -> tuple[str, str]:
        return f"while ({left} != {right}) {{", "}"

    def number(self, value: float) -> str:
        return repr(value) if value >= 0 else f"({value!r})"

    def choice(self, condition: str, yes: str, no: str) -> str:
        return f"{condition} ? {yes} : {no}"

    def power(self, base: str, exponent: float) -> str:
        return f"pow({base}, {exponent!r})"


class CExport(Exporter):
    """Header and source of a machine: the model, and the correction with its limits and fallback.

    The source compiles with ``-std=c99 -Wall -Wextra -Werror``. It has no memory allocation and no recursion; its state
    is static, so one process runs one machine.
    """

    key: ClassVar[str] = "c"
    summary: ClassVar[str] = "C99 source and header: static state, math.h only, with limits and fallback"
    suffix: ClassVar[str] = ".c, .h"

    def refusal(self, export: Export) -> str | None:
        return one_step(export)

    def files(self, export: Export) -> dict[str, str | bytes]:
        return {f"{export.stem}.h": _header(export), f"{export.stem}.c": _source(export)}


def one_step(export: Export) -> str | None:
    """Why a file that runs all axes together cannot, where their steps differ."""
    steps = {a.axis: a.program.step_s for a in export.axes}
    if len(set(steps.values())) == 1:
        return None
    stated = ", ".join(f"{axis} {step_s:g} s" for axis, step_s in steps.items())
    return f"one function runs all axes at one step, got {stated}; export them one by one or resample"


def channels_of(export: Export) -> dict[str, str]:
    """All input channels with their units, in the order of the axes.

    A channel has one unit, as all axes are of one machine.
    """
    return {c: u for a in export.axes for c, u in zip(a.program.channels, a.program.units, strict=True)}


def _header(export: Export) -> str:
    name, upper, step_s = export.stem, export.stem.upper(), export.axes[0].program.step_s
    channels = channels_of(export)
    places = _enumerated(f"{upper}_IN_", channels.items())
    axes = _enumerated(f"{upper}_AXIS_", ((a.axis, "bit in what is returned") for a in export.axes))
    outputs = [(f"{a.axis}_{output}", unit) for a in export.axes for output, unit in a.output_units.items()]
    errors = _enumerated(f"{upper}_OUT_", outputs)
    statement = "\n".join(f" * {line}".rstrip() for line in export.heading())
    return f"""/*
{statement}
 *
 * Inputs stand in inputs[] at the places {upper}_IN_..., NaN where one is missing. Call {name}_step or
 * {name}_correction_step every {step_s:g} s, not both: they share one state. The first row, at the start and after a
 * reset, is that at which every input has been seen.
 */
#ifndef {upper}_H
#define {upper}_H

#define {upper}_N_INPUTS {len(channels)}
#define {upper}_N_AXES {len(export.axes)}
#define {upper}_N_OUTPUTS {len(outputs)}
#define {upper}_STEP_S {step_s!r}
#define {upper}_SIMULATED {int(export.simulated)}
#define {upper}_MODEL {_string(export.model)}
#define {upper}_VERSION {_string(export.version)}
#define {upper}_SHA256 {_string(export.digest)}
#define {upper}_CREATED {_string(export.created)}

/* places in inputs[] */
{places}

/* places in error_um[] */
{errors}

/* axes */
{axes}

/* Forgets all rows and the correction: before the first row, and after the machine was off. */
void {name}_reset(void);

/* One row: error_um[{upper}_N_OUTPUTS] is set. Returns 0, or the sum of 1 << axis over the axes without an output,
 * which are NaN: before the first row, or without a required input. */
int {name}_step(const double inputs[], double error_um[]);

/* One row and one transmission: offset_um[{upper}_N_AXES] is what the control adds, and slope_um_per_m[] its slope, 0
 * for an axis without one. Returns as {name}_step, where an input that is not usable counts as missing. */
int {name}_correction_step(const double inputs[], double offset_um[], double slope_um_per_m[]);

/* The two parts of {name}_correction_step, for transmissions more often than rows: a row every {upper}_STEP_S, and a
 * movement as often as something is sent, with the time since the last one in s. More often means smaller jumps. */
int {name}_correction_row(const double inputs[]);
void {name}_correction_move(double elapsed_s, double offset_um[], double slope_um_per_m[]);

#endif
"""


def _enumerated(prefix: str, members: Iterable[tuple[str, str]]) -> str:
    members = list(members)
    names = [f"{prefix}{n.upper()}" for n in identifiers(name for name, _ in members)]
    lines = [
        f"#define {n} {k} /* {ascii_text(f'{m[0]}, {m[1]}')} */"
        for k, (n, m) in enumerate(zip(names, members, strict=True))
    ]
    return "\n".join(lines) or "/* none */"


def _string(text: str) -> str:
    plain = ascii_text(text).replace("\\", "\\\\").replace('"', '\\"')
    return f'"{plain}"'


def _source(export: Export) -> str:
    name, upper = export.stem, export.stem.upper()
    prefixes = [f"{p}_" for p in identifiers(a.axis for a in export.axes)]
    places = {channel: k for k, channel in enumerate(channels_of(export))}
    axes = "\n".join(_axis(a, p, places) for a, p in zip(export.axes, prefixes, strict=True))
    statement = "\n".join(f" * {line}".rstrip() for line in export.heading(axes=()))
    first, rows, resets, at = [], [], [], 0
    for k, (a, p) in enumerate(zip(export.axes, prefixes, strict=True)):
        first.append(at)
        rows.append(f"    lacking += {p}row(inputs, usable_only, error_um + {at}) << {k};")
        resets.append(f"    {p}begun = 0;")
        if a.program.channels:
            resets += [f"    for (i = 0; i < {len(a.program.channels)}; i++) {{", f"        {p}seen[i] = 0;", "    }"]
        at += len(a.program.outputs)
    limits = [_limit_rows(a) for a in export.axes]
    caps, rates, steps = ([value for rows_ in limits for value in rows_[part]] for part in range(3))
    owner = np.repeat(np.arange(len(export.axes)), [len(a.program.outputs) for a in export.axes])
    per_mm = [-1.0 if not part else -1000.0 for a in export.axes for part in range(len(a.program.outputs))]
    one = [a.limits for a in export.axes]
    tables = "\n".join(
        [
            _table("axis_of", owner),
            _table("is_slope", np.array([int(x != -1.0) for x in per_mm])),
            _table("largest", np.array(caps)),
            _table("rate_per_s", np.array(rates)),
            _table("largest_step", np.array(steps)),
            _table("hold_s", np.array([float(x.hold_s) for x in one])),
            _table("stale_s", np.array([a.stale_s for a in export.axes])),
        ]
    )
    joined_rows, joined_resets = "\n".join(rows), "\n".join(resets)
    return f"""/*
{statement}
 *
 * {name}.h states inputs, outputs, limits and how to call this.
 */
#include "{name}.h"

#include <math.h>

{axes}
static int all_rows(const double inputs[], int usable_only, double error_um[])
{{
    int lacking = 0;
{joined_rows}
    return lacking;
}}

int {name}_step(const double inputs[], double error_um[])
{{
    return all_rows(inputs, 0, error_um);
}}

/* Correction. Outputs are offsets in um and slopes in um/m, in the order of error_um[]. */
{tables}
static double target[{upper}_N_OUTPUTS];
static double sent[{upper}_N_OUTPUTS];
static int valid[{upper}_N_AXES];
static int fresh[{upper}_N_AXES]; /* a valid row has come since the last movement */
static int faulty[{upper}_N_AXES];
static double quiet_s[{upper}_N_AXES]; /* since the last valid row */
static double held_s[{upper}_N_AXES]; /* since the fault began */

void {name}_reset(void)
{{
    int i;
{joined_resets}
    for (i = 0; i < {upper}_N_OUTPUTS; i++) {{
        target[i] = 0.0;
        sent[i] = 0.0;
    }}
    for (i = 0; i < {upper}_N_AXES; i++) {{
        valid[i] = 0;
        fresh[i] = 0;
        faulty[i] = 0;
        quiet_s[i] = 0.0;
        held_s[i] = 0.0;
    }}
}}

int {name}_correction_row(const double inputs[])
{{
    double error_um[{upper}_N_OUTPUTS];
    int lacking = all_rows(inputs, 1, error_um);
    int i;
    for (i = 0; i < {upper}_N_OUTPUTS; i++) {{
        int axis = axis_of[i];
        valid[axis] = !(lacking >> axis & 1);
        if (valid[axis]) {{
            fresh[axis] = 1;
            target[i] = fmin(fmax((is_slope[i] ? -1000.0 : -1.0) * error_um[i], -largest[i]), largest[i]);
        }}
    }}
    return lacking;
}}

void {name}_correction_move(double elapsed_s, double offset_um[], double slope_um_per_m[])
{{
    int i;
    if (!(elapsed_s > 0.0)) {{
        elapsed_s = 0.0;
    }}
    for (i = 0; i < {upper}_N_AXES; i++) {{
        slope_um_per_m[i] = 0.0;
        quiet_s[i] = fresh[i] ? 0.0 : quiet_s[i] + elapsed_s;
        fresh[i] = 0;
        held_s[i] = faulty[i] ? held_s[i] + elapsed_s : 0.0;
        faulty[i] = !valid[i] || quiet_s[i] > stale_s[i];
    }}
    for (i = 0; i < {upper}_N_OUTPUTS; i++) {{
        int axis = axis_of[i];
        double reach = fmin(rate_per_s[i] * fmin(elapsed_s, stale_s[axis]), largest_step[i]);
        if (faulty[axis]) {{
            target[i] = held_s[axis] > hold_s[axis] ? 0.0 : sent[i];
        }}
        sent[i] += fmin(fmax(target[i] - sent[i], -reach), reach);
        if (is_slope[i]) {{
            slope_um_per_m[axis] = sent[i];
        }} else {{
            offset_um[axis] = sent[i];
        }}
    }}
}}

int {name}_correction_step(const double inputs[], double offset_um[], double slope_um_per_m[])
{{
    int lacking = {name}_correction_row(inputs);
    {name}_correction_move({upper}_STEP_S, offset_um, slope_um_per_m);
    return lacking;
}}
"""


def _limit_rows(a: AxisModel) -> tuple[list[float], list[float], list[float]]:
    """Largest value, rate and change of each output: the slope's keep the same limits at the lever of the axis."""
    levers = [1.0, a.lever_m][: len(a.program.outputs)]
    kept = (a.limits.max_offset_um, a.limits.rate_um_per_s, a.step_um if isfinite(a.step_um) else 1e30)
    largest, rate, step = ([float(value) / lever for lever in levers] for value in kept)
    return largest, rate, step


def _table(name: str, values: np.ndarray) -> str:
    kind = "int" if np.issubdtype(values.dtype, np.integer) else "double"
    numbers = number_lines(values, repr)
    if len(numbers) == 1:
        return f"static const {kind} {name}[{len(values)}] = {{{numbers[0]}}};"
    inner = "\n    ".join(numbers)
    return f"static const {kind} {name}[{len(values)}] = {{\n    {inner}\n}};"


def _axis(a: AxisModel, prefix: str, places: Mapping[str, int]) -> str:
    """State, constants and row function of one axis."""
    p, w = a.program, Writer(C(), prefix)
    outputs = [o("0") for o in lower(w, p)]
    count = len(p.channels)
    inputs = f"{prefix}v0"  # the last values
    w.memory.pop(inputs, None)
    w.memory[f"{prefix}begun"] = ("whole", 0)
    if count:
        w.memory |= {inputs: ("real", count), f"{prefix}seen": ("whole", count)}
        bounds = np.array(a.usable()).clip(-1e300, 1e300)
        place = w.table("place", np.array([places[c] for c in p.channels]))
        required = w.table("required", np.array(p.required).astype(int))
        low, high = w.table("low", bounds[:, 0]), w.table("high", bounds[:, 1])
        gather = f"""    for (i = 0; i < {count}; i++) {{
        double x = inputs[{place}[i]];
        int usable = isfinite(x) && (!usable_only || (x >= {low}[i] && x <= {high}[i]));
        if (usable) {{
            {inputs}[i] = x;
            {prefix}seen[i] = 1;
        }} else if ({required}[i]) {{
            lacking = 1;
        }}
        if (!{prefix}seen[i]) {{
            complete = 0;
        }}
    }}"""
        w.scalar("i", "whole")
    else:
        gather = "    (void)inputs;\n    (void)usable_only;"
    kinds = {"real": "double", "whole": "int"}
    constants = "\n".join(_table(name, values) for name, values in w.tables.items())
    state = "\n".join(
        f"static {kinds[kind]} {name}{f'[{size}]' if size else ''};" for name, (kind, size) in w.memory.items()
    )
    local = "\n".join(f"    {kinds[kind]} {name};" for name, kind in w.scalars.items())
    results = "\n".join(f"    error_um[{k}] = lacking ? NAN : {o};" for k, o in enumerate(outputs))
    nothing = "\n".join(f"        error_um[{k}] = NAN;" for k in range(len(outputs)))
    blocks = "\n".join(w.lines)
    return f"""/* Axis {ascii_text(a.axis)} */
{constants}
{state}

static int {prefix}row(const double inputs[], int usable_only, double error_um[])
{{
    int first_row, lacking = 0, complete = 1;
{local}
{gather}
    if (!complete) {{
{nothing}
        return 1;
    }}
    first_row = !{prefix}begun;
    {prefix}begun = 1;
{blocks}
    (void)first_row;
{results}
    return lacking;
}}
"""
