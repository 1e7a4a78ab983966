"""The state machine of `compensation.safety` as a program: one source for Python and for the exports.

The program is elementwise: element i of every input and output is one value that is sent, with its own state. `run` is
the program for one value as compiled Python; exports lower the same program to C and structured text.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from typing import Any

import numpy as np

from compensation.exports.lowering import Language, Writer, lower
from data.batch import Channel
from models.program import Builder, Program

OFF, WARM_UP, ACTIVE, HOLD, FADE_OUT = map(float, range(5))  # `safety.STATES` by number
LONGEST_S = 1e9  # an elapsed time of thirty years: keeps sums finite
LIMITS = ("max_offset_um", "rate_um_per_s", "step_um", "hold_s", "stale_s", "warm_up_s")  # of `safety.Limits`
INPUTS: Mapping[str, str] = {
    "elapsed_s": "s", "wanted_um": "um", "usable": "", "faulty": "", "stopped": "",
    **{name: name.rpartition("_")[2] for name in LIMITS},
}  # fmt: skip
"""Inputs with their units. All are finite. `usable`: 1 where a sample with a usable value has come since the last call;
`faulty`: 1 where one without has; both 0: silence. `stopped`: 1 while the operator has stopped it."""
CARRIED: Mapping[str, float] = {
    "state": OFF, "sent_um": 0.0, "held_s": 0.0, "target_um": 0.0, "warmed": 0.0, "good_s": -1.0, "quiet_s": 0.0,
}  # fmt: skip
"""Outputs, which are also what is carried, with their initial values; `good_s` is -1 after an input that was not
usable. See `safety.Axis`."""


@cache
def core(size: int = 1) -> Program:
    """One step for `size` values: inputs `INPUTS`, outputs `CARRIED`, both (size,) each, one behind the other."""
    names = {name: [f"{name}[{i}]" for i in range(size)] for name in INPUTS}
    b = Builder({n: Channel(n, "driver", INPUTS[name]) for name in INPUTS for n in names[name]}, 1.0)
    given = {name: b.channels(names[name]) for name in INPUTS}
    was = {name: b.previous(size, initial) for name, initial in CARRIED.items()}
    zero, one, none = (b.constant([value] * size) for value in (0.0, 1.0, -1.0))
    off, warm_up, active, hold, fade_out = (
        b.constant([number] * size) for number in (OFF, WARM_UP, ACTIVE, HOLD, FADE_OUT)
    )
    longest = b.constant([LONGEST_S] * size)
    inverse, same = partial(b.sub, one), partial(b.two, "equal")
    both, either = partial(b.two, "mul"), partial(b.two, "max")  # of numbers that are 0 or 1
    elapsed, usable, stopped = b.clamp(given["elapsed_s"], zero, longest), given["usable"], given["stopped"]
    sent, running = was["sent_um"], inverse(stopped)
    at_zero = same(sent, zero)
    quiet = b.two("min", b.two("add", was["quiet_s"], elapsed), longest)
    gap = b.two("less", given["stale_s"], quiet)
    # A stop fades out.
    state = b.select(stopped, b.select(at_zero, off, fade_out), was["state"])
    held = b.select(stopped, zero, was["held_s"])
    warmed = both(running, was["warmed"])
    good = b.select(stopped, none, was["good_s"])
    # Without usable input: hold, after hold_s fade-out. One that began unseen counts from where it should have.
    holds, warms = same(state, hold), same(state, warm_up)
    lost = both(running, either(gap, given["faulty"], both(holds, inverse(usable))))
    engaged, idle = either(warms, same(state, active)), both(warms, at_zero)
    late = either(b.sub(quiet, given["stale_s"]), zero)
    longer = b.two("min", b.two("add", held, b.select(holds, elapsed, b.select(engaged, late, zero))), longest)
    held = b.select(lost, b.select(idle, zero, longer), held)
    state = b.select(both(lost, engaged), b.select(idle, off, hold), state)
    expired = both(lost, same(state, hold), b.two("less", given["hold_s"], held))
    state = b.select(expired, fade_out, state)
    warmed = both(warmed, inverse(expired))
    good = b.select(lost, none, good)
    # With usable input: warm-up, after warm_up_s active.
    used = both(running, usable)
    longer = b.two("min", b.two("add", good, quiet), longest)
    good = b.select(used, b.select(b.two("less", good, zero), zero, longer), good)
    warmed = either(warmed, both(used, inverse(b.two("less", good, given["warm_up_s"]))))
    waiting = b.select(same(state, fade_out), fade_out, warm_up)
    state = b.select(used, b.select(warmed, active, waiting), state)
    acts = both(used, warmed)
    held = b.select(acts, zero, held)
    most, least = given["max_offset_um"], b.sub(zero, given["max_offset_um"])
    target = b.select(acts, b.clamp(given["wanted_um"], least, most), was["target_um"])
    quiet = b.select(usable, zero, quiet)
    # Movement within the limits; a fade-out that has arrived at 0 ends.
    goal = b.select(same(state, active), target, b.select(same(state, fade_out), zero, sent))
    credited = both(given["rate_um_per_s"], b.two("min", elapsed, given["stale_s"]))
    reach = b.two("min", credited, given["step_um"])
    sent = b.clamp(b.clamp(goal, least, most), b.sub(sent, reach), b.two("add", sent, reach))
    ended = both(same(state, fade_out), same(sent, zero))
    state = b.select(ended, b.select(b.two("less", good, zero), off, warm_up), state)
    held = b.select(ended, zero, held)

    after = dict(zip(CARRIED, (state, sent, held, target, warmed, good, quiet), strict=True))
    for name, node in was.items():
        b.feed(node, after[name])
    return b.program(list(after.values()), zero_start=False)


def lower_core(w: Writer, given: Mapping[str, Sequence[str]], limits: Sequence[object]) -> list[list[str]]:
    """Writes the core behind what sets its inputs, and gives `CARRIED` as expressions, an element for each value.

    Args:
        given: expressions of the inputs in front of the limits, one for each value.
        limits: `safety.Limits` of each value.
    """
    before = [expression for name in list(INPUTS)[: -len(LIMITS)] for expression in given[name]]
    for k, expression in enumerate(before):
        w.put(f"{w.prefix}core_v0[{k}]", expression)
    table = w.table("core_limits", np.array([float(getattr(each, name)) for name in LIMITS for each in limits]))
    with w.loop(len(LIMITS) * len(limits)) as i:
        w.put(f"{w.prefix}core_v0[{len(before)} + {i}]", f"{table}[{i}]")
    program = core(len(limits))
    return lower(w, program, "core_", _labels(program))


def _labels(program: Program) -> dict[int, str]:
    """Names of the nodes that are inputs, outputs, and outputs of the row before."""
    names = dict(zip(program.outputs, CARRIED, strict=True))
    size = len(program.channels) // len(INPUTS)
    for k, n in enumerate(program.nodes):
        if n.op == "pick":
            names[k] = list(INPUTS)[int(n.data["places"][0]) // size]
        elif n.op == "previous":
            names[k] = f"{names[n.args[0]]}_before"
    return names


@cache
def run() -> Callable[..., tuple[float, ...]]:
    """`step(inputs, *carried) -> carried`: the core for one value; `inputs` in the order of `INPUTS`."""
    program, w = core(), Writer(Language())
    results = ", ".join(element for (element,) in lower(w, program))
    carried = [f"v{program.outputs[k]}" for k in range(len(CARRIED))]
    text = "\n".join([f"def step(v0, {', '.join(carried)}, first_row=False):", *w.lines, f"    return {results}"])
    space: dict[str, Any] = {}
    exec(compile(text, "<compensation.core>", "exec"), space)
    step: Callable[..., tuple[float, ...]] = space["step"]
    return step
