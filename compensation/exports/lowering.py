"""Programs as statements of a language with arrays, loops and branches: C and structured text.

Node k becomes one block that sets the array ``v<k>``, or the number of that name where it has one element; ``s<k>`` is
what it carries from row to row, ``c<k>_<name>`` its constants. All keep their values from row to row. `first_row` is
true in the first row, in which every block sets its own state: a reset needs no more.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import MappingProxyType
from typing import ClassVar

import numpy as np

from compensation.core import CARRIED, INPUTS, LIMITS, core
from compensation.exports.base import ascii_text
from data.arrays import Array
from models.program import Node, Program

_UNROLLED = 8  # places of a `pick` that are written one by one
_NUMBERS_A_LINE = 5
Shape = tuple[str, int]  # "real", "whole" or "logical", and the length; 0 for a single value


class Language:
    """Spelling of statements, here of C99; others override what differs.

    Operators + - * / < and indices x[i] are the same in all languages.
    """

    functions: ClassVar[Mapping[str, str]] = {
        "abs": "fabs", "exp": "exp", "min": "fmin", "max": "fmax", "single": "(double)(float)", "tanh": "tanh",
        "or": "||", "less": "<", "equal": "==",
    }  # fmt: skip

    def comment(self, text: str) -> str:
        return f"/* {ascii_text(text)} */"

    def put(self, target: str, value: str) -> str:
        return f"{target} = {value};"

    def loop(self, index: str, count: int | str, first: int | str = 0) -> tuple[str, str]:
        """First and last line of a loop over first … count − 1."""
        return f"for ({index} = {first}; {index} < {count}; {index}++) {{", "}"

    def when(self, condition: str) -> tuple[str, str, str]:
        """First line, line before what else is done, and last line of a branch."""
        return f"if ({condition}) {{", "} else {", "}"

    def repeat(self, left: str, right: str) -> tuple[str, str]:
        """First and last line of a loop while two whole numbers differ."""
        return f"while ({left} != {right}) {{", "}"

    def number(self, value: float) -> str:
        """A number inside an expression."""
        return repr(value) if value >= 0 else f"({value!r})"

    def choice(self, condition: str, yes: str, no: str) -> str:
        """An expression that is `yes` where the condition holds, else `no`; both are evaluated or free of effects."""
        return f"{condition} ? {yes} : {no}"

    def power(self, base: str, exponent: float) -> str:
        """base ** exponent for a base above 0."""
        return f"pow({base}, {exponent!r})"

    def call(self, function: str, *args: str) -> str:
        return f"{self.functions[function]}({', '.join(args)})"

    def tanh(self, w: Writer, target: str, x: str) -> None:
        """Statements that set the target to tanh x."""
        w.put(target, self.call("tanh", x))


class Writer:
    """Collects statements, and the variables and constants that they need, by name."""

    def __init__(self, language: Language, prefix: str = "", indent: int = 1) -> None:
        self.language, self.prefix, self.indent = language, prefix, indent
        self.lines: list[str] = []
        self.tables: dict[str, Array] = {}  # constants; whole numbers where the array's type is
        self.memory: dict[str, Shape] = {}
        self.scalars: dict[str, str] = {}

    def line(self, text: str) -> None:
        self.lines.append(("    " * self.indent + text).rstrip())

    def comment(self, text: str) -> None:
        self.line(self.language.comment(text))

    def put(self, target: str, value: str) -> None:
        self.line(self.language.put(target, value))

    def table(self, name: str, values: Array) -> str:
        self.tables[self.prefix + name] = values
        return self.prefix + name

    def array(self, name: str, size: int, kind: str = "real") -> str:
        self.memory[self.prefix + name] = (kind, size)
        return self.prefix + name

    def scalar(self, name: str, kind: str = "real") -> str:
        self.scalars[name] = kind
        return name

    @contextmanager
    def loop(self, count: int, index: str = "i", first: int | str = 0) -> Iterator[str]:
        """The index as an expression; a loop of one round is written without one."""
        if count == 1 and first == 0:
            yield "0"
            return
        head, tail = self.language.loop(self.scalar(index, "whole"), count, first)
        with self._block(head, tail):
            yield index

    @contextmanager
    def repeat(self, left: str, right: str) -> Iterator[None]:
        with self._block(*self.language.repeat(left, right)):
            yield

    @contextmanager
    def when(self, condition: str) -> Iterator[None]:
        head, _, tail = self.language.when(condition)
        with self._block(head, tail):
            yield

    @contextmanager
    def otherwise(self) -> Iterator[None]:
        """Directly behind `when`."""
        _, head, tail = self.language.when("")
        self.lines.pop()
        with self._block(head, tail):
            yield

    @contextmanager
    def _block(self, head: str, tail: str) -> Iterator[None]:
        self.line(head)
        self.indent += 1
        yield
        self.indent -= 1
        self.line(tail)


_SIGNS: Mapping[str, str] = {"add": "+", "sub": "-", "mul": "*"}
_COMPARED = ("less", "equal")
_EACH = {*_SIGNS, *_COMPARED, "min", "max", "select"}  # computed element by element
_FOLDED = 60  # characters of an expression that is written where it is used


class _Lowered:
    """The blocks of one program: a method for each operation, by its name."""

    def __init__(self, w: Writer, program: Program, labels: Mapping[int, str]) -> None:
        self.w, self.language, self.program, self.labels = w, w.language, program, labels
        uses = Counter(a for n in program.nodes for a in n.args)
        later = {a for n in program.nodes for a in n.args if n.op == "previous"}
        self.single = {k for k, count in uses.items() if count == 1} - {*labels, *later, *program.outputs}
        self.folded: set[int] = set()  # nodes that are written where they are used

    def item(self, k: int, index: str) -> str:
        """Element of node k; that of a single value whatever the index is."""
        n = self.program.nodes[k]
        if n.op == "constant":
            return self.part(k, "value", index, n.size)
        if k in self.folded:
            return f"({self.value(k, index)})"
        single = n.size == 1 and k > 0
        name = self.w.array(self.labels.get(k, f"v{k}"), 0 if single else n.size)
        return name if single else f"{name}[{'0' if n.size == 1 else index}]"

    def part(self, k: int, name: str, index: str, size: int) -> str:
        """Element of a constant of node k that has one number for each of `size` or one for all."""
        values = np.broadcast_to(self.program.nodes[k].data[name], size)
        if (values == values[0]).all():
            return self.language.number(float(values[0]))
        return f"{self.w.table(f'c{k}_{name}', values)}[{index}]"

    def block(self, k: int) -> None:
        n = self.program.nodes[k]
        if n.size == 0 or n.op in ("input", "constant"):
            return
        if n.op in _EACH:
            if k in self.single and len(self.value(k, "i")) <= _FOLDED:
                self.folded.add(k)
                return
        elif k not in self.labels:
            of = f" of {', '.join(f'v{a}' for a in n.args)}" if n.args else ""
            self.w.comment(f"v{k}: {n.op}{of}")
        getattr(self, n.op)(k, n)

    def join(self, k: int, n: Node) -> None:
        at = 0
        for a in n.args:
            size = self.program.nodes[a].size
            if size:
                with self.w.loop(size) as i:
                    place = str(at) if i == "0" else f"{at} + {i}" if at else i
                    self.w.put(self.item(k, place), self.item(a, i))
            at += size

    def pick(self, k: int, n: Node) -> None:
        places = n.data["places"].astype(int)
        if n.size <= _UNROLLED or len(set(places)) == 1:
            for to, place in enumerate(places):
                self.w.put(self.item(k, str(to)), self.item(n.args[0], str(place)))
            return
        table = self.w.table(f"c{k}_places", places)
        with self.w.loop(n.size) as i:
            self.w.put(self.item(k, i), self.item(n.args[0], f"{table}[{i}]"))

    def affine(self, k: int, n: Node) -> None:
        width = self.program.nodes[n.args[0]].size
        with self.w.loop(n.size) as i:
            offset = self.part(k, "offset", i, n.size)
            if not width:
                self.w.put(self.item(k, i), offset)
                return
            total = self.w.scalar("total")
            self.w.put(total, offset)
            matrix = self.w.table(f"c{k}_matrix", n.data["matrix"].ravel())
            with self.w.loop(width, "j") as j:
                place = j if i == "0" else f"{i} * {width} + {j}" if width > 1 else i
                self.w.put(total, f"{total} + {matrix}[{place}] * {self.item(n.args[0], j)}")
            self.w.put(self.item(k, i), total)

    def value(self, k: int, i: str) -> str:
        """An element of a node that computes each of its own from those of its arguments."""
        n, one, zero = self.program.nodes[k], self.language.number(1.0), self.language.number(0.0)
        if n.op == "select":
            yes, no = (self.item(x, i) for x in n.args[1:])
            return self.language.choice(self.condition(n.args[0], i), yes, no)
        if n.op in _COMPARED:
            return self.language.choice(self.compared(k, i), one, zero)
        a, b = (self.item(x, i) for x in n.args)
        return self.language.call(n.op, a, b) if n.op in ("min", "max") else f"{a} {_SIGNS[n.op]} {b}"

    def compared(self, k: int, i: str) -> str:
        n = self.program.nodes[k]
        return f" {self.language.functions[n.op]} ".join(self.item(x, i) for x in n.args)

    def condition(self, k: int, i: str) -> str:
        """Whether a node that is 0 or 1 is 1."""
        folded = k in self.folded and self.program.nodes[k].op in _COMPARED
        return self.compared(k, i) if folded else f"{self.item(k, i)} > {self.language.number(0.5)}"

    def each(self, k: int, n: Node) -> None:
        with self.w.loop(n.size) as i:
            self.w.put(self.item(k, i), self.value(k, i))

    add = sub = mul = min = max = less = equal = select = each

    def previous(self, k: int, n: Node) -> None:
        with self.w.loop(n.size) as i:  # its argument is computed below, and still has the value of the row before
            self.w.put(self.item(k, i), self.item(n.args[0], i))
        with self.w.when("first_row"), self.w.loop(n.size) as i:
            self.w.put(self.item(k, i), self.part(k, "initial", i, n.size))

    def power(self, k: int, n: Node) -> None:
        exponents = np.broadcast_to(n.data["exponents"], n.size)
        for i, exponent in enumerate(exponents.tolist()):
            target, x = self.item(k, str(i)), self.language.call("abs", self.item(n.args[0], str(i)))
            if exponent == 1.0:
                self.w.put(target, x)
                continue
            with self.w.when(f"{x} > {self.language.number(0.0)}"):
                self.w.put(target, self.language.power(x, exponent))
            with self.w.otherwise():  # not every language defines a power of 0
                self.w.put(
                    target, self.language.number(0.0**exponent if exponent >= 0.0 else float(np.finfo(float).max))
                )

    def median(self, k: int, n: Node) -> None:
        (a,), size = n.args, self.program.nodes[n.args[0]].size
        if size == 1:
            self.w.put(self.item(k, "0"), self.item(a, "0"))
            return
        order = self.w.array(f"o{k}", size)
        with self.w.loop(size) as i:
            self.w.put(f"{order}[{i}]", self.item(a, i))
        held = self.w.scalar("held")
        with (
            self.w.loop(size - 1, "i") as i,
            self.w.loop(size, "j", f"{i} + 1") as j,
            self.w.when(f"{order}[{j}] < {order}[{i}]"),
        ):
            self.w.put(held, f"{order}[{i}]")
            self.w.put(f"{order}[{i}]", f"{order}[{j}]")
            self.w.put(f"{order}[{j}]", held)
        half = self.language.number(0.5)
        self.w.put(self.item(k, "0"), f"{half} * ({order}[{(size - 1) // 2}] + {order}[{size // 2}])")

    def first(self, k: int, n: Node) -> None:
        with self.w.when("first_row"), self.w.loop(n.size) as i:
            self.w.put(self.item(k, i), self.item(n.args[0], i))

    def lag(self, k: int, n: Node) -> None:
        with self.w.loop(n.size) as i:
            v, x, keep = self.item(k, i), self.item(n.args[0], i), self.part(k, "keep", i, n.size)
            with self.w.when("first_row"):
                self.w.put(v, f"{self.part(k, 'begin', i, n.size)} * {x}")
            with self.w.otherwise():
                self.w.put(v, f"{keep} * {v} + ({self.language.number(1.0)} - {keep}) * {x}")

    def _ring(self, k: int, n: Node, rows: int) -> tuple[str, str]:
        """Advances a ring of rows to the place of the newest, 0 in the first row: its array and that place."""
        ring, head = self.w.array(f"s{k}", rows * n.size), self.w.array(f"n{k}", 0, "whole")
        self.w.put(head, f"{head} + 1")
        with self.w.when(f"first_row {self.language.functions['or']} {head} >= {rows}"):
            self.w.put(head, "0")
        return ring, head

    def _earlier(self, head: str, rows: int, ahead: int, name: str) -> str:
        """The place `ahead` of the newest, which is the oldest for 1."""
        place = self.w.scalar(name, "whole")
        self.w.put(place, f"{head} + {ahead}")
        with self.w.when(f"{place} >= {rows}"):
            self.w.put(place, f"{place} - {rows}")
        return place

    def delay(self, k: int, n: Node) -> None:
        rows, part = int(n.data["rows"][0]) + 2, float(n.data["part"][0])
        ring, head = self._ring(k, n, rows)
        with self.w.when("first_row"), self.w.loop(rows, "j") as j, self.w.loop(n.size) as i:
            start = f"{self.part(k, 'begin', i, n.size)} * {self.item(n.args[0], i)}"
            self.w.put(f"{ring}[{self._at(j, n, i)}]", start)
        with self.w.loop(n.size) as i:
            self.w.put(f"{ring}[{self._at(head, n, i)}]", self.item(n.args[0], i))
        near = self._earlier(head, rows, 2, "row_near")
        far = self._earlier(head, rows, 1, "row_far") if part else ""
        with self.w.loop(n.size) as i:
            value = f"{ring}[{self._at(near, n, i)}]"
            if part:
                shares = self.language.number(1.0 - part), self.language.number(part)
                value = f"{shares[0]} * {value} + {shares[1]} * {ring}[{self._at(far, n, i)}]"
            self.w.put(self.item(k, i), value)

    def _at(self, row: str, n: Node, i: str) -> str:
        return row if n.size == 1 else f"{row} * {n.size} + {i}"

    def rate(self, k: int, n: Node) -> None:
        rows = int(n.data["rows"][0])
        ring, head = self._ring(k, n, rows + 1)
        seen, far = self.w.array(f"r{k}", 0, "whole"), self.w.scalar("row_far", "whole")
        with self.w.when("first_row"):
            self.w.put(seen, "0")
        with self.w.otherwise(), self.w.when(f"{seen} < {rows}"):
            self.w.put(seen, f"{seen} + 1")
        with self.w.loop(n.size) as i:
            self.w.put(f"{ring}[{self._at(head, n, i)}]", self.item(n.args[0], i))
        self.w.put(far, f"{head} - {seen}")
        with self.w.when(f"{far} < 0"):
            self.w.put(far, f"{far} + {rows + 1}")
        with self.w.when("first_row"), self.w.loop(n.size) as i:
            self.w.put(self.item(k, i), self.language.number(0.0))
        with self.w.otherwise(), self.w.loop(n.size) as i:
            rise = f"{self.item(n.args[0], i)} - {ring}[{self._at(far, n, i)}]"
            hours = self.language.number(self.program.step_s / 3600.0)
            self.w.put(self.item(k, i), f"({rise}) / ({seen} * {hours})")

    def clock(self, k: int, n: Node) -> None:
        with self.w.when("first_row"):
            self.w.put(self.item(k, "0"), self.language.number(0.0))
        with self.w.otherwise():
            self.w.put(self.item(k, "0"), f"{self.item(k, '0')} + {self.language.number(self.program.step_s)}")

    def curve(self, k: int, n: Node) -> None:
        knots, values = n.data["knots"], n.data["values"]
        zero = self.language.number(0.0)
        with self.w.loop(n.size) as i:
            total = self.w.scalar("total")
            self.w.put(total, self.language.number(float(values[0])))
            if len(knots) > 1:
                knot, wide, slope = curve_pieces(n)
                names = [self.w.table(f"c{k}_{t}", v) for t, v in (("knots", knot), ("wide", wide), ("slopes", slope))]
                with self.w.loop(len(knot), "j") as j:
                    beyond = f"{self.item(n.args[0], i)} - {names[0]}[{j}]"
                    inside = self.language.call("min", self.language.call("max", beyond, zero), f"{names[1]}[{j}]")
                    self.w.put(total, f"{total} + {names[2]}[{j}] * {inside}")
            self.w.put(self.item(k, i), total)

    def tanh(self, k: int, n: Node) -> None:
        with self.w.loop(n.size) as i:
            self.language.tanh(self.w, self.item(k, i), self.item(n.args[0], i))

    def kernel(self, k: int, n: Node) -> None:
        support, weights = np.atleast_2d(n.data["support"]), n.data["weights"]
        rows, width = support.shape
        total, away, d = self.w.scalar("total"), self.w.scalar("away"), self.w.scalar("apart")
        self.w.put(total, self.language.number(0.0))
        with self.w.loop(rows) as i:
            self.w.put(away, self.language.number(0.0))
            if width:
                name = self.w.table(f"c{k}_support", support.ravel())
                with self.w.loop(width, "j") as j:
                    place = i if width == 1 else f"{i} * {width} + {j}"
                    self.w.put(d, f"{name}[{place}] - {self.item(n.args[0], j)}")
                    self.w.put(away, f"{away} + {d} * {d}")
            exponent = f"{self.language.number(-float(n.data['sharpness'][0]))} * {away}"
            weight = f"{self.w.table(f'c{k}_weights', weights)}[{i}]"
            self.w.put(total, f"{total} + {weight} * {self.language.call('exp', exponent)}")
        self.w.put(self.item(k, "0"), total)

    def trees(self, k: int, n: Node) -> None:
        d, w = n.data, self.w
        whole = {name: w.table(f"c{k}_{name}", d[name].astype(int)) for name in ("roots", "feature", "left", "right")}
        real = {name: w.table(f"c{k}_{name}", d[name]) for name in ("threshold", "value")}
        (a,) = n.args
        seen = w.array(f"o{k}", max(self.program.nodes[a].size, 1))
        with w.loop(self.program.nodes[a].size) as i:
            x = self.item(a, i)
            w.put(f"{seen}[{i}]", self.language.call("single", x) if d["single"][0] else x)
        total, node = w.scalar("total"), w.scalar("node", "whole")
        w.put(total, self.language.number(0.0))
        with w.loop(len(d["roots"])) as i:
            w.put(node, f"{whole['roots']}[{i}]")
            with w.repeat(f"{whole['left']}[{node}]", node):  # a leaf is its own child
                with w.when(f"{seen}[{whole['feature']}[{node}]] <= {real['threshold']}[{node}]"):
                    w.put(node, f"{whole['left']}[{node}]")
                with w.otherwise():
                    w.put(node, f"{whole['right']}[{node}]")
            w.put(total, f"{total} + {real['value']}[{node}]")
        w.put(self.item(k, "0"), total)


def curve_pieces(n: Node) -> tuple[Array, Array, Array]:
    """Knots, widths and slopes of a curve's pieces: it is values[0] + Σ slope · min(max(x − knot, 0), width)."""
    knots, values = n.data["knots"], n.data["values"]
    wide = np.diff(knots)
    return knots[:-1], wide, np.divide(np.diff(values), wide, out=np.zeros_like(wide), where=wide > 0)


def lower(
    w: Writer, program: Program, prefix: str = "", labels: Mapping[int, str] = MappingProxyType({})
) -> list[list[str]]:
    """Writes the blocks of all nodes, named with a prefix and by their labels; the elements of each output as
    expressions."""
    outer, w.prefix = w.prefix, w.prefix + prefix
    lowered = _Lowered(w, program, labels)
    for k in range(len(program.nodes)):
        lowered.block(k)
    elements = [[lowered.item(o, str(i)) for i in range(program.nodes[o].size)] for o in program.outputs]
    w.prefix = outer
    return elements


def lower_over(w: Writer, program: Program, prefix: str, channels: Sequence[str]) -> str:
    """The same of a program over some of the channels in ``v0``: its last output; one before that replaces them."""
    w.memory[f"{w.prefix}{prefix}v0"] = ("real", len(program.channels))
    places = [f"{w.prefix}v0[{channels.index(c)}]" for c in program.channels]
    for k, place in enumerate(places):
        w.put(f"{w.prefix}{prefix}v0[{k}]", place)
    *replaced, (last,) = lower(w, program, prefix)
    for values in replaced:
        for place, value in zip(places, values, strict=True):
            w.put(place, value)
    return last


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


def number_lines(values: Array, number: Callable[[float], str]) -> list[str]:
    """The numbers of a constant array, separated by commas, a few a line; whole ones where the array's type is."""
    whole = np.issubdtype(values.dtype, np.integer)
    texts = [str(int(v)) if whole else number(float(v)) for v in values.tolist()]
    wide = _NUMBERS_A_LINE * (3 if whole else 1)
    return [", ".join(texts[i : i + wide]) + ("," if i + wide < len(texts) else "") for i in range(0, len(texts), wide)]
