"""Export: C99 source and header with static state, without dependencies beyond math.h."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import ClassVar

import numpy as np

from compensation.core import INPUTS
from compensation.exports.base import MOST, Export, ExportedAxis, Exporter, ascii_text, identifiers, stale_rows
from compensation.exports.lowering import Language, Writer, lower, lower_core, lower_over, number_lines


class CExport(Exporter):
    """Header and source of a machine: the model, and the correction with its limits and fallback.

    The source compiles with ``-std=c99 -Wall -Wextra -Werror``. It has no memory allocation and no recursion; its state
    is static, so one process runs one machine.
    """

    key: ClassVar[str] = "c"
    summary: ClassVar[str] = "C99 source and header: static state, math.h only, with limits and fallback"
    suffix: ClassVar[str] = ".c, .h"

    def refusal(self, export: Export) -> str | None:
        return one_step(export) or stale_rows(export)

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

/* Forgets all rows: before the first row, and after the machine was off. What is sent goes on from where it is. */
void {name}_reset(void);

/* One row: error_um[{upper}_N_OUTPUTS] is set. Returns 0, or the sum of 1 << axis over the axes without an output,
 * which are NaN: before the first row, or without a required input. */
int {name}_step(const double inputs[], double error_um[]);

/* One row and one transmission: offset_um[{upper}_N_AXES] is what the control adds, and slope_um_per_m[] its slope, 0
 * for an axis without one. Returns as {name}_step, where an input that is not usable or fails counts as missing. */
int {name}_correction_step(const double inputs[], double offset_um[], double slope_um_per_m[]);

/* The two parts of {name}_correction_step, for transmissions more often than rows: a row every {upper}_STEP_S, and a
 * movement as often as something is sent, with the time since the last one in s. More often means smaller jumps. */
int {name}_correction_row(const double inputs[]);
void {name}_correction_move(double elapsed_s, double offset_um[], double slope_um_per_m[]);

{SHARED.format(name=name)}
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


SHARED = """/* 0 stops an axis: it fades out and stays off; 1 starts it again. */
void {name}_enable(int axis, int enabled);

/* State of an axis: 0 off, 1 warm-up, 2 active, 3 hold, 4 fade-out. */
int {name}_state(int axis);
"""


def move_source(export: Export, function: str) -> str:
    """What both sources share: the state machine of what is sent, moved by its inputs in static arrays by a
    function whose head is `function` and the arguments of a movement."""
    name, sent = export.stem, [(k, a, *out) for k, a in enumerate(export.axes) for out in a.sent]
    w, count = Writer(Language()), len(sent)
    given = {
        "elapsed_s": ["elapsed_s"] * count,
        **{n: [f"{n}[{i}]" for i in range(count)] for n in ("wanted_um", "usable", "faulty")},
        "stopped": [f"stopped[{k}]" for k, *_ in sent],
    }
    w.scalar("i", "whole")
    state, now_um, *_ = lower_core(w, given, [a.limits for _, a, *_ in sent])
    w.memory["core_v0"] = ("real", len(INPUTS) * count)
    results = [f"    slope_um_per_m[{k}] = 0.0;" for k in range(len(export.axes))]
    states = []
    for (k, _, output, _, um), value, number in zip(sent, now_um, state, strict=True):
        results.append(f"    {output}[{k}] = {value}{'' if um == 1.0 else f' / {um!r}'};")
        states += [number] if output == "offset_um" else []
    lines, joined, where = "\n".join(w.lines), "\n".join(results), ", ".join(states)
    return f"""/* What is sent, by its state machine: movements within the limits of size, rate and step. */
{_declared(w)}
static double wanted_um[{count}]; /* at the tool */
static double usable[{count}]; /* 1 where a usable value has come since the last movement */
static double faulty[{count}]; /* 1 where one has come that is not */
static double stopped[{len(export.axes)}];
static int core_begun;

{function}(double elapsed_s, double offset_um[], double slope_um_per_m[])
{{
    static double last_s; /* an elapsed time that is no number counts as the one before */
    int first_row = !core_begun;
{_locals(w)}
    core_begun = 1;
    if (elapsed_s > 0.0 && elapsed_s <= 1e300) {{
        last_s = elapsed_s;
    }}
    elapsed_s = elapsed_s <= 0.0 ? 0.0 : last_s;
{lines}
    for (i = 0; i < {count}; i++) {{
        usable[i] = 0.0;
        faulty[i] = 0.0;
    }}
{joined}
}}

void {name}_enable(int axis, int enabled)
{{
    stopped[axis] = enabled ? 0.0 : 1.0;
}}

int {name}_state(int axis)
{{
    const double states[{len(states)}] = {{{where}}};
    return core_begun ? (int)states[axis] : 0;
}}
"""


def _source(export: Export) -> str:
    name, upper = export.stem, export.stem.upper()
    prefixes = [f"{p}_" for p in identifiers(a.axis for a in export.axes)]
    places = {channel: k for k, channel in enumerate(channels_of(export))}
    axes = "\n".join(_axis(a, p, places) for a, p in zip(export.axes, prefixes, strict=True))
    statement = "\n".join(f" * {line}".rstrip() for line in export.heading(axes=()))
    rows, resets, at = [], [], 0
    for k, (a, p) in enumerate(zip(export.axes, prefixes, strict=True)):
        rows.append(f"    lacking += {p}row(inputs, usable_only, error_um + {at}, trust + {k}) << {k};")
        resets.append(f"    {p}begun = 0;")
        resets += [f"    {p}seen[{c}] = 0;" for c in range(len(a.program.channels))]
        at += len(a.program.outputs)
    owner = np.repeat(np.arange(len(export.axes)), [len(a.sent) for a in export.axes])
    # The model's outputs are um and um/mm.
    scale = np.array([-um * (1000.0 if unit != "um" else 1.0) for a in export.axes for _, unit, um in a.sent])
    tables = "\n".join([_table("axis_of", owner), _table("um_at_the_tool", scale)])
    joined_rows, joined_resets = "\n".join(rows), "\n".join(resets)
    return f"""/*
{statement}
 *
 * {name}.h states inputs, outputs, limits and how to call this.
 */
#include "{name}.h"

#include <math.h>

{axes}
static int all_rows(const double inputs[], int usable_only, double error_um[], double trust[])
{{
    int lacking = 0;
{joined_rows}
    return lacking;
}}

int {name}_step(const double inputs[], double error_um[])
{{
    double trust[{upper}_N_AXES];
    return all_rows(inputs, 0, error_um, trust);
}}

void {name}_reset(void)
{{
{joined_resets}
}}

{move_source(export, f"void {name}_correction_move")}
/* In the order of error_um[]. */
{tables}

int {name}_correction_row(const double inputs[])
{{
    double error_um[{upper}_N_OUTPUTS], trust[{upper}_N_AXES];
    int lacking = all_rows(inputs, 1, error_um, trust);
    int i;
    for (i = 0; i < {upper}_N_OUTPUTS; i++) {{
        int axis = axis_of[i];
        int valid = !(lacking >> axis & 1);
        wanted_um[i] = valid ? um_at_the_tool[i] * error_um[i] * trust[axis] : 0.0;
        usable[i] = valid ? 1.0 : 0.0;
        faulty[i] = valid ? 0.0 : 1.0;
    }}
    return lacking;
}}

int {name}_correction_step(const double inputs[], double offset_um[], double slope_um_per_m[])
{{
    int lacking = {name}_correction_row(inputs);
    {name}_correction_move({upper}_STEP_S, offset_um, slope_um_per_m);
    return lacking;
}}
"""


_KINDS: Mapping[str, str] = {"real": "double", "whole": "int"}


def _declared(w: Writer) -> str:
    """Constants and state."""
    constants = [_table(name, values) for name, values in w.tables.items()]
    state = [f"static {_KINDS[kind]} {name}{f'[{size}]' if size else ''};" for name, (kind, size) in w.memory.items()]
    return "\n".join([*constants, *state])


def _locals(w: Writer) -> str:
    return "\n".join(f"    {_KINDS[kind]} {name};" for name, kind in w.scalars.items())


def _table(name: str, values: np.ndarray) -> str:
    kind = "int" if np.issubdtype(values.dtype, np.integer) else "double"
    numbers = number_lines(values, repr)
    if len(numbers) == 1:
        return f"static const {kind} {name}[{len(values)}] = {{{numbers[0]}}};"
    inner = "\n    ".join(numbers)
    return f"static const {kind} {name}[{len(values)}] = {{\n    {inner}\n}};"


def _axis(a: ExportedAxis, prefix: str, places: Mapping[str, int]) -> str:
    """State, constants and row function of one axis."""
    p, w = a.program, Writer(Language(), prefix)
    if a.checks is not None:
        with w.when("usable_only"):
            w.put("lacking", f"{lower_over(w, a.checks, 'checks_', p.channels)} > 0.5 ? 1 : lacking")
    outputs = [element for (element,) in lower(w, p)]
    trust = lower_over(w, a.trust, "trust_", p.channels) if a.trust is not None else "1.0"
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
    checks = "\n".join(f"    lacking |= !(fabs({o}) <= {MOST!r});" for o in outputs)
    results = "\n".join(f"    error_um[{k}] = lacking ? NAN : {o};" for k, o in enumerate(outputs))
    nothing = "\n".join(f"        error_um[{k}] = NAN;" for k in range(len(outputs)))
    blocks = "\n".join(w.lines)
    return f"""/* Axis {ascii_text(a.axis)} */
{_declared(w)}

static int {prefix}row(const double inputs[], int usable_only, double error_um[], double *trust)
{{
    int first_row, lacking = 0, complete = 1;
{_locals(w)}
{gather}
    *trust = 1.0;
    if (!complete) {{
{nothing}
        return 1;
    }}
    first_row = !{prefix}begun;
    {prefix}begun = 1;
{blocks}
    (void)first_row;
    *trust = {trust};
{checks}
{results}
    return lacking;
}}
"""
