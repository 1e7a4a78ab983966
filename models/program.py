"""A fitted model as a program: a short list of vector operations with carried state, plain data.

From a program come single steps in process, the ONNX file and the code for controls, so that all of them compute the
same. A family gives one by `Family.program`; `Builder` has the features of `features.rises`. `OPERATIONS` states what
each operation gives; `Node.state_size` which of them carry state.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np

from data.arrays import Array
from data.batch import Channel
from data.checks.base import THERMAL
from data.errors import InputError
from features.rises import RATE_WINDOW_S, parsed_feature

OPERATIONS: Mapping[str, str] = {
    "input": "the row's channels in their order, a missing one at its last value",
    "constant": "value",
    "join": "all arguments, one behind the other",
    "pick": "x[places], counted from 0",
    "affine": "matrix @ x + offset",
    "add": "a + b, element by element",
    "sub": "a - b, element by element",
    "min": "the smaller of a and b, element by element",
    "max": "the larger of a and b, element by element",
    "less": "1 where a < b, else 0",
    "equal": "1 where a = b, else 0",
    "select": "b where a is 1, c where a is 0",
    "previous": "what the argument, a later node, was in the row before; `initial` in the first row",
    "mul": "a * b, element by element",
    "power": "|x| ** exponents, element by element",
    "median": "median of x, one value",
    "first": "x of the first row",
    "lag": "v = keep * v + (1 - keep) * x; in the first row v = begin * x",
    "delay": "(1 - part) * (x `rows` rows earlier) + part * (x one more row earlier); before the first row begin * "
    "(x of the first row)",
    "rate": "(x - x `rows` rows earlier) per hour; from the first row while that is nearer; 0 in the first row",
    "clock": "s since the first row",
    "curve": "values at x, linear between knots, held beyond",
    "tanh": "tanh x",
    "kernel": "weights @ exp(-|support - x|^2 * sharpness)",
    "trees": "sum over roots: from node = root, node = left[node] if x[feature[node]] <= threshold[node] else "
    "right[node], until node is its own child; value[node]. With single, x is rounded to single precision first",
}


@dataclass(frozen=True)
class Node:
    """One operation: `args` are numbers of earlier nodes, of `previous` of a later one; `size` is the length of its
    output, `data` its constants."""

    op: str
    args: tuple[int, ...]
    size: int
    data: Mapping[str, Array] = field(default_factory=dict)

    def state_size(self) -> int:
        """Numbers that it carries from row to row."""
        match self.op:
            case "input" | "first" | "lag" | "previous":
                return self.size
            case "delay" | "rate":
                return self.size * (int(self.data["rows"][0]) + (2 if self.op == "delay" else 1))
            case "clock":
                return 1
        return 0


@dataclass(frozen=True)
class Program:
    """Operations that give a model's output for one row after the other, at a fixed step.

    Attributes:
        channels: names of the raw channels, in the units of the machine file, that a row consists of.
        units: of each channel.
        required: of each channel whether a row without it has no output; another is bridged by its last value.
        step_s: time between rows.
        nodes: the first is the input.
        outputs: nodes: of a model the error in µm, along an axis also its slope in µm/mm, one value each.
        along, reference_mm: channel and P0 of the position along which the error is offset + slope · (P − P0).
    """

    channels: tuple[str, ...]
    units: tuple[str, ...]
    required: tuple[bool, ...]
    step_s: float
    nodes: tuple[Node, ...]
    outputs: tuple[int, ...]
    along: str = ""
    reference_mm: float = 0.0

    def begin(self) -> State:
        """The state before a batch's first row."""
        return State(np.full(len(self.channels), np.nan), [np.zeros(n.state_size()) for n in self.nodes])

    def runner(self) -> Callable[[State, Array], Array]:
        """`run(state, row) -> outputs (o,)`: one step that changes the state; see `State`.

        A batch begins with the first row at which every channel has been seen; the outputs are NaN before, and in a
        row without a required channel, which the state passes over at the last value.
        """
        made = [_STEPS[n.op](n, self.step_s) for n in self.nodes[1:]]
        args = [() if n.op == "previous" else n.args for n in self.nodes[1:]]
        later = [(k, n.args[0]) for k, n in enumerate(self.nodes) if n.op == "previous"]
        required = np.array(self.required, bool)
        every = bool(required.all())
        outputs = list(self.outputs)
        nothing = np.full(self.width, np.nan)
        values: list[Array] = [np.empty(0)] * len(self.nodes)

        def run(state: State, row: Array) -> Array:
            missing = row != row
            lacking = bool(missing.any())
            if lacking:
                row = np.where(missing, state.held, row)
            state.held = row
            if not state.started and np.isnan(row).any():
                return nothing
            values[0] = row
            begin = not state.started
            for k, (step, places) in enumerate(zip(made, args, strict=True), 1):
                values[k] = step(state.carried[k], begin, *[values[a] for a in places])
            for k, place in later:
                state.carried[k] = values[place]
            state.started = True
            if lacking and (every or bool(missing[required].any())):
                return nothing
            return values[outputs[0]].copy() if len(outputs) == 1 else np.concatenate([values[o] for o in outputs])

        return run

    def scaled(self, share: float) -> Self:
        """This program with `share` times its outputs."""
        size = [self.nodes[k].size for k in self.outputs]
        parts = [
            Node("affine", (k,), n, {"matrix": share * np.eye(n), "offset": np.zeros(n)})
            for k, n in zip(self.outputs, size, strict=True)
        ]
        outputs = tuple(range(len(self.nodes), len(self.nodes) + len(parts)))
        return replace(self, nodes=(*self.nodes, *parts), outputs=outputs)

    @property
    def width(self) -> int:
        """Number o of output values."""
        return sum(self.nodes[k].size for k in self.outputs)

    def as_plain(self) -> dict[str, Any]:
        """Numbers, strings, lists and arrays."""
        nodes = [{"op": n.op, "args": list(n.args), "size": n.size, "data": dict(n.data)} for n in self.nodes]
        return {
            "channels": list(self.channels), "units": list(self.units), "required": list(self.required),
            "step_s": self.step_s, "nodes": nodes, "outputs": list(self.outputs), "along": self.along,
            "reference_mm": self.reference_mm,
        }  # fmt: skip

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> Self:
        """The inverse of `as_plain`."""
        nodes = tuple(
            Node(n["op"], tuple(n["args"]), int(n["size"]), {k: np.asarray(v, float) for k, v in n["data"].items()})
            for n in plain["nodes"]
        )
        return cls(
            tuple(plain["channels"]), tuple(plain["units"]), tuple(plain["required"]), float(plain["step_s"]), nodes,
            tuple(plain["outputs"]), plain["along"], float(plain["reference_mm"]),
        )  # fmt: skip


@dataclass
class State:
    """What a run of a program carries: the channels' last values, the operations' own numbers, whether it has begun."""

    held: Array
    carried: list[Array]
    started: bool = False

    def as_plain(self) -> dict[str, Any]:
        """Lists of numbers; NaN as None."""
        lists = [[None if v != v else v for v in c.tolist()] for c in (self.held, *self.carried)]
        return {"held": lists[0], "carried": lists[1:], "started": self.started}

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> Self:
        """The inverse of `as_plain`."""
        held, *carried = (
            np.array([np.nan if v is None else v for v in c], float) for c in (plain["held"], *plain["carried"])
        )
        return cls(held, carried, bool(plain["started"]))


def replay(program: Program, rows: Array) -> Array:
    """Outputs (n, o) of a whole batch, rows (n, m)."""
    run, state = program.runner(), program.begin()
    return np.array([run(state, row) for row in rows]).reshape(len(rows), program.width)


class Builder:
    """Makes a program node by node; every method returns the number of a node."""

    def __init__(self, channels: Mapping[str, Channel], step_s: float) -> None:
        if not step_s > 0:
            raise InputError(f"program of a model: step is {step_s:g} s; expected the positive step it was trained at")
        self.known, self.step_s = channels, step_s
        self.names: list[str] = []
        self.required: list[bool] = []
        self.nodes: list[Node] = [Node("input", (), 0)]

    def add(self, op: str, args: Sequence[int], size: int, **data: Any) -> int:
        """A node; the same one is not made twice."""
        arrays = {k: np.atleast_1d(np.asarray(v, float)) for k, v in data.items()}
        for number, n in enumerate(self.nodes):
            same = (n.op, n.args, n.size) == (op, tuple(args), size) and n.data.keys() == arrays.keys()
            if number and same and all(np.array_equal(n.data[k], v) for k, v in arrays.items()):
                return number
        self.nodes.append(Node(op, tuple(args), size, arrays))
        return len(self.nodes) - 1

    def size(self, node: int) -> int:
        return self.nodes[node].size

    def channels(self, names: Sequence[str], required: bool = True) -> int:
        """Raw channels as one vector.

        Raises:
            InputError: a channel that the machine does not have.
        """
        for name in names:
            if name not in self.known:
                raise InputError(f"program of a model: the machine has no channel {name!r}; give its own machine file")
            if name not in self.names:
                self.names.append(name)
                self.required.append(required)
            elif required:
                self.required[self.names.index(name)] = True
        return self.add("pick", [0], len(names), places=[self.names.index(n) for n in names])

    def pick(self, x: int, places: Sequence[int]) -> int:
        whole = list(places) == list(range(self.size(x)))
        return x if whole else self.add("pick", [x], len(places), places=list(places))

    def join(self, *parts: int) -> int:
        return parts[0] if len(parts) == 1 else self.add("join", parts, sum(map(self.size, parts)))

    def since_first(self, x: int) -> int:
        return self.sub(x, self.add("first", [x], self.size(x)))

    def sub(self, a: int, b: int) -> int:
        return self.add("sub", [a, b], self.size(a))

    def two(self, op: str, a: int, *others: int) -> int:
        """`add`, `mul`, `min`, `max`, `less` or `equal`, element by element; of more than two from the left."""
        for b in others:
            a = self.add(op, [a, b], self.size(a))
        return a

    def select(self, condition: int, a: int, b: int) -> int:
        return self.add("select", [condition, a, b], self.size(a))

    def clamp(self, x: int, low: int, high: int) -> int:
        return self.two("min", self.two("max", x, low), high)

    def previous(self, size: int, initial: float = 0.0) -> int:
        """What a node that `feed` names later was in the row before, and `initial` in the first row."""
        self.nodes.append(Node("previous", (), size, {"initial": np.full(size, float(initial))}))
        return len(self.nodes) - 1

    def feed(self, previous: int, later: int) -> None:
        self.nodes[previous] = replace(self.nodes[previous], args=(later,))

    def affine(self, x: int, matrix: Array, offset: Array | float = 0.0) -> int:
        """matrix (m, n) · x (n,) + offset (m,)."""
        matrix = np.atleast_2d(matrix)
        return self.add("affine", [x], len(matrix), matrix=matrix, offset=np.broadcast_to(offset, len(matrix)))

    def scaled(self, x: int, scale: Array, shift: Array | float = 0.0) -> int:
        """(x − shift) / scale, element by element."""
        centred = self.sub(x, self.constant(np.broadcast_to(shift, self.size(x)))) if np.any(shift) else x
        return self.add("mul", [centred, self.constant(1.0 / np.broadcast_to(scale, self.size(x)))], self.size(x))

    def constant(self, value: Array | Sequence[float] | float) -> int:
        """A node of constant value (n,)."""
        value = np.atleast_1d(value)
        return self.add("constant", [], len(value), value=value)

    def lag(self, x: int, tau_s: Array | float, begin: Array | float) -> int:
        """First-order lag, exact for x held over the step; starts at `begin` (0 or 1) times its first x; τ of 0: x."""
        tau = np.broadcast_to(np.asarray(tau_s, float), self.size(x))
        if not tau.any():
            return x
        with np.errstate(divide="ignore"):
            keep = np.where(tau > 0, np.exp(-self.step_s / tau), 0.0)
        start = np.where(tau > 0, np.broadcast_to(begin, self.size(x)), 1.0)
        return self.add("lag", [x], self.size(x), keep=keep, begin=start)

    def lags(self, x: int, taus_s: Sequence[float], begin: float) -> int:
        """x behind each of the time constants, joined."""
        n = self.size(x)
        return self.lag(self.join(*[x] * len(taus_s)), np.repeat(taus_s, n), begin)

    def delay(self, x: int, delay_s: float, begin: Array | float) -> int:
        """x delayed by `delay_s`, linear between rows; before the start `begin` (0 or 1) times its first x."""
        rows = delay_s / self.step_s
        if rows == 0:
            return x
        whole = int(rows + 1e-9)
        part = rows - whole if rows - whole > 1e-6 else 0.0
        start = np.broadcast_to(begin, self.size(x))
        return self.add("delay", [x], self.size(x), rows=whole, part=part, begin=start)

    def thermal(self, name: str) -> bool:
        return self.known[name].role in THERMAL

    def features(self, names: Sequence[str], required: bool = True) -> int:
        """Inputs by their names, see `features.rises`, in their order.

        Raises:
            InputError: an unknown channel or kind of feature.
        """
        groups: dict[tuple[str, float, bool], list[int]] = {}
        parts = [parsed_feature(n) for n in names]
        for k, (channel, kind, tau_s) in enumerate(parts):
            self.channels([channel], required)
            groups.setdefault((kind, tau_s, self.thermal(channel)), []).append(k)
        made, order = [], []
        for (kind, tau_s, thermal), places in groups.items():
            raw = self.channels([parts[k][0] for k in places], required)
            made.append(self._feature(raw, kind, tau_s, thermal, required))
            order += places
        joined = self.join(*made) if made else self.constant(np.zeros(0))
        return self.pick(joined, np.argsort(order).tolist())

    def _feature(self, raw: int, kind: str, tau_s: float, thermal: bool, required: bool) -> int:
        n = self.size(raw)
        if kind == "start":
            return self.add("first", [raw], n)
        if kind == "ambient":
            ambient = next((c for c, spec in self.known.items() if spec.role == "ambient"), "")
            return self.since_first(self.sub(raw, self.channels([ambient] * n, required)))
        base = self.since_first(raw) if thermal else raw
        if kind == "rate":
            return self.add("rate", [base], n, rows=max(1, round(RATE_WINDOW_S / self.step_s)))
        return self.lag(base, tau_s, 1.0 if thermal else 0.0)

    def program(self, outputs: Sequence[int], zero_start: bool, along: str = "", reference_mm: float = 0.0) -> Program:
        """The program of these outputs; each is 0 in the first row with `zero_start`."""
        ends = [self.since_first(o) for o in outputs] if zero_start else list(outputs)
        nodes = [Node("input", (), len(self.names)), *self.nodes[1:]]
        used: set[int] = set()
        found = {0, *ends}
        while found:
            used |= found
            found = {a for number in found for a in nodes[number].args} - used
        place = {number: k for k, number in enumerate(sorted(used))}
        kept = tuple(replace(nodes[n], args=tuple(place[a] for a in nodes[n].args)) for n in place)
        units = tuple(self.known[n].unit for n in self.names)
        return Program(tuple(self.names), units, tuple(self.required), self.step_s, kept,
                       tuple(place[o] for o in ends), along, reference_mm)  # fmt: skip


Step = Callable[..., Array]  # (own state, whether this is the first row, *arguments) -> output; the state is changed


def _join(n: Node, step_s: float) -> Step:
    return lambda s, begin, *parts: np.concatenate(parts)


def _pick(n: Node, step_s: float) -> Step:
    places = n.data["places"].astype(int)
    return lambda s, begin, x: x[places]


def _affine(n: Node, step_s: float) -> Step:
    matrix, offset = n.data["matrix"], n.data["offset"]
    return lambda s, begin, x: matrix @ x + offset


def _first(n: Node, step_s: float) -> Step:
    def step(s: Array, begin: bool, x: Array) -> Array:
        if begin:
            s[:] = x
        return s.copy()

    return step


def _lag(n: Node, step_s: float) -> Step:
    keep, start = n.data["keep"], n.data["begin"]

    def step(s: Array, begin: bool, x: Array) -> Array:
        s[:] = start * x if begin else keep * s + (1.0 - keep) * x
        return s.copy()

    return step


def _delay(n: Node, step_s: float) -> Step:
    part, start = n.data["part"][0], n.data["begin"]

    def step(s: Array, begin: bool, x: Array) -> Array:
        kept = s.reshape(-1, n.size)  # oldest first
        if begin:
            kept[:] = start * x
        kept[:-1] = kept[1:].copy()
        kept[-1] = x
        return np.asarray((1.0 - part) * kept[1] + part * kept[0])

    return step


def _rate(n: Node, step_s: float) -> Step:
    rows = int(n.data["rows"][0])

    def step(s: Array, begin: bool, x: Array) -> Array:
        kept = s.reshape(-1, n.size)  # a count of rows cannot be distinguished from them, so unseen ones are NaN
        if begin:
            kept[:] = np.nan
        kept[:-1] = kept[1:].copy()
        kept[-1] = x
        first = int(np.argmax(~np.isnan(kept[:, 0])))
        return np.asarray((x - kept[first]) / (max(rows - first, 1) * step_s / 3600.0))

    return step


def _clock(n: Node, step_s: float) -> Step:
    def step(s: Array, begin: bool) -> Array:
        s[0] = 0.0 if begin else s[0] + step_s
        return s.copy()

    return step


def _kernel(n: Node, step_s: float) -> Step:
    support, weights, sharpness = n.data["support"], n.data["weights"], n.data["sharpness"][0]

    def step(s: Array, begin: bool, x: Array) -> Array:
        away = support - x
        return np.array([weights @ np.exp(-sharpness * np.einsum("ij,ij->i", away, away))])

    return step


def _trees(n: Node, step_s: float) -> Step:
    d = n.data
    feature, left, right = (d[k].astype(int) for k in ("feature", "left", "right"))
    threshold, value, roots, single = d["threshold"], d["value"], d["roots"].astype(int), bool(d["single"][0])

    def step(s: Array, begin: bool, x: Array) -> Array:
        seen = x.astype(np.float32).astype(float) if single else x
        node = roots
        while True:
            child = np.where(seen[feature[node]] <= threshold[node], left[node], right[node])
            if np.array_equal(child, node):
                return np.array([value[node].sum()])
            node = child

    return step


_STEPS: Mapping[str, Callable[[Node, float], Step]] = {
    "constant": lambda n, step_s: lambda s, begin: n.data["value"],
    "join": _join,
    "pick": _pick,
    "affine": _affine,
    "add": lambda n, step_s: lambda s, begin, a, b: a + b,
    "sub": lambda n, step_s: lambda s, begin, a, b: a - b,
    "mul": lambda n, step_s: lambda s, begin, a, b: a * b,
    "min": lambda n, step_s: lambda s, begin, a, b: np.minimum(a, b),
    "max": lambda n, step_s: lambda s, begin, a, b: np.maximum(a, b),
    "less": lambda n, step_s: lambda s, begin, a, b: (a < b).astype(float),
    "equal": lambda n, step_s: lambda s, begin, a, b: (a == b).astype(float),
    "select": lambda n, step_s: lambda s, begin, c, a, b: np.asarray(np.where(c > 0.5, a, b), float),
    "previous": lambda n, step_s: lambda s, begin: n.data["initial"] if begin else s,
    "power": lambda n, step_s: lambda s, begin, x: np.abs(x) ** n.data["exponents"],
    "median": lambda n, step_s: lambda s, begin, x: np.array([np.median(x)]),
    "first": _first,
    "lag": _lag,
    "delay": _delay,
    "rate": _rate,
    "clock": _clock,
    "curve": lambda n, step_s: lambda s, begin, x: np.atleast_1d(np.interp(x, n.data["knots"], n.data["values"])),
    "tanh": lambda n, step_s: lambda s, begin, x: np.tanh(x),
    "kernel": _kernel,
    "trees": _trees,
}
