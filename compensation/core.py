"""The state machine of `compensation.safety` as a program: one source for Python and for the exports.

The program is elementwise: element i of every input and output is one value that is sent, with its own state. `run`
steps through the operations for one value; exports lower the same program to C and structured text.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial

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


_ON_NUMBERS: Mapping[str, Callable[..., float]] = {  # on arrays, as `Program.runner` has them, four times as slow
    "add": operator.add, "sub": operator.sub, "mul": operator.mul, "min": min, "max": max,
    "less": lambda a, b: float(a < b), "equal": lambda a, b: float(a == b),
    "select": lambda condition, a, b: a if condition > 0.5 else b,
}  # fmt: skip


@cache
def run() -> Callable[..., tuple[float, ...]]:
    """`step(inputs, *carried) -> carried`: the core for one value; `inputs` in the order of `INPUTS`."""
    program = core()
    initial = [float(n.data["value"][0]) if n.op == "constant" else 0.0 for n in program.nodes]
    picked = [(k, int(n.data["places"][0])) for k, n in enumerate(program.nodes) if n.op == "pick"]
    previous = [k for k, n in enumerate(program.nodes) if n.op == "previous"]  # in the order of `CARRIED`
    given = {"input", "constant", "pick", "previous"}
    computed = [(k, _ON_NUMBERS[n.op], n.args) for k, n in enumerate(program.nodes) if n.op not in given]

    def step(inputs: Sequence[float], *carried: float) -> tuple[float, ...]:
        values = initial.copy()
        for k, place in picked:
            values[k] = inputs[place]
        for k, value in zip(previous, carried, strict=True):
            values[k] = value
        for k, operation, args in computed:
            values[k] = operation(*[values[a] for a in args])
        return tuple([values[k] for k in program.outputs])

    return step
