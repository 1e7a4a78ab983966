"""Export: ONNX graphs in double precision, one for a step and one for a whole batch of each axis."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from compensation.exports.base import Export, ExportedAxis, Exporter, identifiers
from compensation.exports.lowering import curve_pieces
from data.arrays import Array
from models.program import Node, Program

OPSET, IR_VERSION = 17, 8  # the oldest pair that has all operations in double precision: more runtimes read it


class OnnxExport(Exporter):
    """Two files for each axis. Everything is float64, except inputs of trees that were fitted in single precision.

    ``…_AXIS.onnx`` is one row: inputs `row` (m,), `state` (s,) and `started` (bool), outputs `error_um` (o,),
    `state_out` and `started_out`. The state before the first row is in the metadata: m times NaN, then zeros. It holds
    the numbers of `models.program.State` in their order. ``…_AXIS_batch.onnx`` is all rows of a batch: input `rows`
    (n, m), output `error_um` (n, o). The second output along an axis is the slope in µm/mm.
    """

    key: ClassVar[str] = "onnx"
    summary: ClassVar[str] = "ONNX graphs in double precision: a step with carried state, and a whole batch"
    suffix: ClassVar[str] = "_AXIS.onnx, _AXIS_batch.onnx"

    def files(self, export: Export) -> dict[str, str | bytes]:
        out: dict[str, str | bytes] = {}
        for a, name in zip(export.axes, identifiers(x.axis for x in export.axes), strict=True):
            stem = f"{export.stem}_{name}"
            out[f"{stem}.onnx"] = _model(export, a, _step(a, ("row", "state", "started")))
            out[f"{stem}_batch.onnx"] = _model(export, a, _batch(a))
        return out


def metadata(export: Export, axis: ExportedAxis) -> dict[str, str]:
    """What `metadata_props` states: texts as they are, everything else as JSON."""
    stated = axis.described()
    channels = {part: json.dumps([i[name] for i in stated["inputs"]]) for part, name in _COLUMNS.items()}
    rest = {key: json.dumps(stated[key]) for key in ("outputs", "position", "step_s", "trained_region", "limits")}
    sizes = [n.state_size() for n in axis.program.nodes[1:]]
    return {
        **{key: value if isinstance(value, str) else json.dumps(value) for key, value in export.described().items()},
        "axis": axis.axis,
        "remark": axis.remark,
        **channels,
        **rest,
        "fallback": stated["fallback"],
        "state": json.dumps({"nan": len(axis.program.channels), "zeros": sum(sizes)}),
    }


_COLUMNS: Mapping[str, str] = {
    "channels": "channel", "units": "unit", "required": "required", "trained": "trained", "usable": "usable",
}  # fmt: skip


class Graph:
    """Collects nodes and constants; every method returns the name of a tensor."""

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.constants: dict[str, Any] = {}
        self._named: dict[tuple[str, tuple[int, ...], bytes], str] = {}
        self.count = 0

    def op(self, kind: str, *inputs: str, outputs: int = 1, name: str = "", **attributes: Any) -> str:
        """The first output of a new node."""
        self.count += 1
        names = [name or f"t{self.count}", *(f"t{self.count}_{k}" for k in range(1, outputs))]
        self.nodes.append(helper.make_node(kind, inputs, names, **attributes))
        return names[0]

    def constant(self, values: Any) -> str:
        array = np.array(values, order="C")
        key = (array.dtype.str, array.shape, array.tobytes())
        if key not in self._named:
            self._named[key] = f"c{len(self._named)}"
            self.constants[self._named[key]] = numpy_helper.from_array(array, self._named[key])
        return self._named[key]

    def real(self, values: Any) -> str:
        return self.constant(np.atleast_1d(np.asarray(values, np.float64)))

    def whole(self, values: Any) -> str:
        return self.constant(np.atleast_1d(np.asarray(values, np.int64)))

    def count_of(self, flags: str) -> str:
        """How many are true, (1,)."""
        return self.op("ReduceSum", self.op("Cast", flags, to=TensorProto.INT64), self.whole([0]), keepdims=1)


Step = Callable[["Graph", Program, Node, str, tuple[str, ...]], tuple[str, str]]
"""(graph, program, node, own state, arguments) -> output, new state ("" for an operation without one)."""


def _join(g: Graph, p: Program, n: Node, s: str, x: tuple[str, ...]) -> tuple[str, str]:
    return g.op("Concat", *x, axis=0), ""


def _pick(g: Graph, p: Program, n: Node, s: str, x: tuple[str, ...]) -> tuple[str, str]:
    return g.op("Gather", x[0], g.whole(n.data["places"].astype(int)), axis=0), ""


def _affine(g: Graph, p: Program, n: Node, s: str, x: tuple[str, ...]) -> tuple[str, str]:
    if not n.data["matrix"].size:
        return g.real(n.data["offset"]), ""
    return g.op("Add", g.op("MatMul", g.constant(n.data["matrix"].astype(float)), x[0]), g.real(n.data["offset"])), ""


def _power(g: Graph, p: Program, n: Node, s: str, x: tuple[str, ...]) -> tuple[str, str]:
    return g.op("Pow", g.op("Abs", x[0]), g.real(n.data["exponents"])), ""


def _median(g: Graph, p: Program, n: Node, s: str, x: tuple[str, ...]) -> tuple[str, str]:
    size = p.nodes[n.args[0]].size
    ordered = g.op("TopK", x[0], g.whole([size]), outputs=2, axis=0)
    middle = g.op("Gather", ordered, g.whole([(size - 1) // 2, size // 2]), axis=0)
    return g.op("Mul", g.op("ReduceSum", middle, g.whole([0]), keepdims=1), g.real(0.5)), ""


def _first(g: Graph, p: Program, n: Node, s: str, x: tuple[str, ...]) -> tuple[str, str]:
    value = g.op("Where", "started", s, x[0])
    return value, value


def _lag(g: Graph, p: Program, n: Node, s: str, x: tuple[str, ...]) -> tuple[str, str]:
    keep = n.data["keep"]
    later = g.op("Add", g.op("Mul", g.real(keep), s), g.op("Mul", g.real(1.0 - keep), x[0]))
    value = g.op("Where", "started", later, g.op("Mul", g.real(n.data["begin"]), x[0]))
    return value, value


def _pushed(g: Graph, n: Node, s: str, x: str, rows: int, begin: str) -> tuple[str, str]:
    """The rows (rows, size), oldest first, with x at their end, and x as a row; `begin` fills them before the first."""
    kept = g.op("Reshape", s, g.whole([rows, n.size]))
    row = g.op("Reshape", x, g.whole([1, n.size]))
    kept = g.op("Where", "started", kept, begin)
    return g.op("Concat", g.op("Gather", kept, g.whole(np.arange(1, rows)), axis=0), row, axis=0), row


def _flat(g: Graph, kept: str) -> str:
    return g.op("Reshape", kept, g.whole([-1]))


def _delay(g: Graph, p: Program, n: Node, s: str, x: tuple[str, ...]) -> tuple[str, str]:
    part = float(n.data["part"][0])
    start = g.op("Mul", g.real(n.data["begin"]), x[0])
    kept, _ = _pushed(g, n, s, x[0], int(n.data["rows"][0]) + 2, g.op("Reshape", start, g.whole([1, n.size])))
    near, far = (_flat(g, g.op("Gather", kept, g.whole([place]), axis=0)) for place in (1, 0))
    value = g.op("Add", g.op("Mul", g.real(1.0 - part), near), g.op("Mul", g.real(part), far)) if part else near
    return value, _flat(g, kept)


def _rate(g: Graph, p: Program, n: Node, s: str, x: tuple[str, ...]) -> tuple[str, str]:
    rows = int(n.data["rows"][0])
    kept, _ = _pushed(g, n, s, x[0], rows + 1, g.constant(np.full((1, n.size), np.nan)))
    unseen = g.count_of(g.op("IsNaN", _flat(g, g.op("Gather", kept, g.whole([0]), axis=1))))
    oldest = _flat(g, g.op("Gather", kept, unseen, axis=0))  # unseen rows stand in front of it
    behind = g.op("Max", g.op("Sub", g.whole([rows]), unseen), g.whole([1]))
    hours = g.op("Mul", g.op("Cast", behind, to=TensorProto.DOUBLE), g.real(p.step_s / 3600.0))
    return g.op("Div", g.op("Sub", x[0], oldest), hours), _flat(g, kept)


def _clock(g: Graph, p: Program, n: Node, s: str, x: tuple[str, ...]) -> tuple[str, str]:
    value = g.op("Where", "started", g.op("Add", s, g.real(p.step_s)), g.real(0.0))
    return value, value


def _curve(g: Graph, p: Program, n: Node, s: str, x: tuple[str, ...]) -> tuple[str, str]:
    knot, wide, slope = curve_pieces(n)
    base = g.real(np.full(n.size, n.data["values"][0]))
    if not len(knot):
        return base, ""
    beyond = g.op("Sub", g.op("Reshape", x[0], g.whole([-1, 1])), g.real(knot))
    inside = g.op("Min", g.op("Max", beyond, g.real(0.0)), g.real(wide))
    return g.op("Add", g.op("MatMul", inside, g.real(slope)), base), ""


def _kernel(g: Graph, p: Program, n: Node, s: str, x: tuple[str, ...]) -> tuple[str, str]:
    away = g.op("Sub", g.constant(np.atleast_2d(n.data["support"])), x[0])
    square = g.op("ReduceSum", g.op("Mul", away, away), g.whole([1]), keepdims=0)
    values = g.op("Exp", g.op("Mul", square, g.real(-n.data["sharpness"][0])))
    return g.op("MatMul", g.constant(n.data["weights"][None]), values), ""


def _trees(g: Graph, p: Program, n: Node, s: str, x: tuple[str, ...]) -> tuple[str, str]:
    """All trees walk one level at a time, as many levels as the deepest has."""
    d = n.data
    left, right, roots = (d[k].astype(np.int64) for k in ("left", "right", "roots"))
    seen = x[0]
    if d["single"][0]:
        seen = g.op("Cast", g.op("Cast", seen, to=TensorProto.FLOAT), to=TensorProto.DOUBLE)
    tables = [g.whole(left), g.whole(right), g.whole(d["feature"].astype(int)), g.real(d["threshold"])]
    node, level = g.whole(roots), np.unique(roots)
    while len(level := level[left[level] != level]):
        to_left, to_right, feature, threshold = (g.op("Gather", table, node, axis=0) for table in tables)
        less = g.op("LessOrEqual", g.op("Gather", seen, feature, axis=0), threshold)
        node = g.op("Where", less, to_left, to_right)
        level = np.unique(np.concatenate([left[level], right[level]]))
    return g.op("ReduceSum", g.op("Gather", g.real(d["value"]), node, axis=0), g.whole([0]), keepdims=1), ""


def _two(op: str) -> Step:
    return lambda g, p, n, s, x: (g.op(op, *x), "")


_STEPS: Mapping[str, Step] = {
    "constant": lambda g, p, n, s, x: (g.real(n.data["value"]), ""),
    "join": _join,
    "pick": _pick,
    "affine": _affine,
    **{op.lower(): _two(op) for op in ("Add", "Sub", "Mul", "Min", "Max")},
    "less": lambda g, p, n, s, x: (g.op("Cast", g.op("Less", *x), to=TensorProto.DOUBLE), ""),
    "equal": lambda g, p, n, s, x: (g.op("Cast", g.op("Equal", *x), to=TensorProto.DOUBLE), ""),
    "select": lambda g, p, n, s, x: (g.op("Where", g.op("Less", g.real(0.5), x[0]), *x[1:]), ""),
    "previous": lambda g, p, n, s, x: (g.op("Where", "started", s, g.real(n.data["initial"])), ""),
    "power": _power,
    "median": _median,
    "first": _first,
    "lag": _lag,
    "delay": _delay,
    "rate": _rate,
    "clock": _clock,
    "curve": _curve,
    "tanh": lambda g, p, n, s, x: (g.op("Tanh", x[0]), ""),
    "kernel": _kernel,
    "trees": _trees,
}


def _sizes(axis: ExportedAxis) -> tuple[int, int, int]:
    """Channels, numbers carried, outputs."""
    p = axis.program
    return len(p.channels), sum(n.state_size() for n in p.nodes[1:]), p.width


def _step(axis: ExportedAxis, order: tuple[str, str, str]) -> Any:
    """The graph of one row; `order` is that of its inputs, and in `state` first that of its outputs too."""
    p, g = axis.program, Graph()
    channels, carried, outputs = _sizes(axis)
    none = g.real(np.zeros(0))
    held, missing = none, ""
    if channels:
        missing = g.op("IsNaN", "row")
        held = g.op("Where", missing, g.op("Gather", "state", g.whole(np.arange(channels)), axis=0), "row")
    values, states, at = [held], [], channels
    for n in p.nodes[1:]:
        size = n.state_size()
        own = g.op("Gather", "state", g.whole(np.arange(at, at + size)), axis=0) if size else none
        at += size
        given = () if n.op == "previous" else n.args
        value, state = _STEPS[n.op](g, p, n, own, tuple(values[a] for a in given))
        values.append(value)
        states += [(state, n)] if size else []
    result = g.op("Concat", *(values[o] for o in p.outputs), axis=0)
    carries = [values[n.args[0]] if n.op == "previous" else state for state, n in states]
    new = g.op("Concat", *carries, axis=0) if carries else none
    if channels:
        complete = g.op("Equal", g.count_of(g.op("IsNaN", held)), g.whole([0]))
        required = g.constant(np.array(p.required, bool))
        there = g.op("Equal", g.count_of(g.op("And", missing, required)), g.whole([0]))
        if carried:
            old = g.op("Gather", "state", g.whole(np.arange(channels, channels + carried)), axis=0)
            new = g.op("Where", complete, new, old)
        result = g.op("Where", g.op("And", complete, there), result, g.real(np.full(outputs, np.nan)))
        g.op("Reshape", complete, g.constant(np.zeros(0, np.int64)), name="started_out")
    else:
        g.op("Identity", g.constant(np.array(True)), name="started_out")
    g.op("Concat", held, new, axis=0, name="state_out")
    g.op("Identity", result, name="error_um")
    shapes = {"row": [channels], "state": [channels + carried], "started": []}
    inputs = [_value(name, shapes[name]) for name in order]
    made = {name: _value(name, shape) for name, shape in (
        ("error_um", [outputs]), ("state_out", [channels + carried]), ("started_out", []))}  # fmt: skip
    ends = ("error_um", "state_out", "started_out") if order[0] == "row" else ("state_out", "started_out", "error_um")
    return helper.make_graph(g.nodes, "step", inputs, [made[e] for e in ends], list(g.constants.values()))


def _value(name: str, shape: list[Any]) -> Any:
    kind = TensorProto.BOOL if name.startswith("started") else TensorProto.DOUBLE
    return helper.make_tensor_value_info(name, kind, shape)


def _batch(axis: ExportedAxis) -> Any:
    """The graph of all rows: the step, scanned from the state before the first row."""
    channels, carried, outputs = _sizes(axis)
    start: Array = np.concatenate([np.full(channels, np.nan), np.zeros(carried)])
    begin = [numpy_helper.from_array(start, "state_begin"), numpy_helper.from_array(np.array(False), "started_begin")]
    body = _step(axis, ("state", "started", "row"))
    names = ["state_begin", "started_begin", "rows"], ["state_end", "started_end", "error_um"]
    scan = helper.make_node("Scan", *names, num_scan_inputs=1, body=body)
    return helper.make_graph(
        [scan], "batch", [_value("rows", ["n", channels])], [_value("error_um", ["n", outputs])], begin
    )


def _model(export: Export, axis: ExportedAxis, graph: Any) -> bytes:
    model = helper.make_model(
        graph, producer_name="thermodrift", opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION
    )
    helper.set_model_props(model, metadata(export, axis))
    onnx.checker.check_model(model)
    content: bytes = model.SerializeToString()
    return content
