"""A calibrated machine file: the old one's text with the new values, read back before it replaces anything."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import yaml

from data.errors import InputError, WorkError
from data.files import write_atomic
from data.machine import parse_machine
from twin.calibration.identifiability import Interval
from twin.compile import compile_network, own_paths
from twin.network import Network
from twin.quantity import Parameter
from twin.schema import twin_part


@dataclass(frozen=True)
class Update:
    """One parameter's new value and 90 % interval, in the parameter's unit."""

    parameter: Parameter
    value: float
    interval90: tuple[float, float]


def with_values(text: str, updates: Mapping[str, Update], where: str) -> str:
    """The machine file's text with calibrated values; each keeps its prior's centre beside it.

    `updates` by parameter path ("links.shaft-front.conductance").

    Raises:
        InputError: a path that the text does not hold as a value of its own (an anchor, a mechanism's default).
    """
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    edits: list[tuple[int, int, str]] = []
    for path, update in updates.items():
        node = _find(root, ["twin", *_steps(path)])
        if node is None:
            raise InputError(
                f"{where}: twin.{path} does not stand in the file as a value with a spread; write it there"
            )
        edits += _edits(node, update)
    for start, end, new in sorted(edits, reverse=True):
        text = text[:start] + new + text[end:]
    return text


def with_calibrated(text: str, lines: str) -> str:
    """The text with the twin part's `calibrated` entry replaced by `lines` (YAML of a mapping, not indented)."""
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    twin = _entry(root, "twin")
    if not isinstance(twin, yaml.MappingNode):
        return text
    indent = " " * twin.value[0][0].start_mark.column
    block = f"{indent}calibrated:\n" + "".join(f"{indent}  {line}\n" for line in lines.rstrip().splitlines())
    for key, value in twin.value:
        if key.value == "calibrated":
            start = key.start_mark.index - key.start_mark.column
            end = text.rfind("\n", 0, value.end_mark.index) + 1  # the mark stands behind the next key's indentation
            return text[:start] + block + text[end:]
    first = twin.value[0][0].start_mark
    at = first.index - first.column
    return text[:at] + block + text[at:]


def _steps(path: str) -> list[str]:
    """ "errors.z.chain[0].length" → errors, z, chain, 0, length."""
    return path.replace("[", ".").replace("]", "").split(".")


def _find(node: yaml.Node | None, steps: list[str]) -> yaml.Node | None:
    """The node at a path; parameters stand a level deeper, a lone conductance a level higher, than their path."""
    while steps and node is not None:
        here = _entry(node, steps[0])
        if here is None and steps[0] == "conductance" and _entry(node, "value") is not None:
            here = node
        if here is None:
            deeper = _entry(node, "parameters")
            here = _entry(deeper, steps[0]) if deeper is not None else None
        node, steps = here, steps[1:]
    return node


def _entry(node: yaml.Node | None, key: str) -> yaml.Node | None:
    if isinstance(node, yaml.SequenceNode):
        return node.value[int(key)] if key.isdigit() and int(key) < len(node.value) else None
    if not isinstance(node, yaml.MappingNode):
        return None
    return next((v for k, v in node.value if k.value == key), None)


def _edits(node: yaml.Node, update: Update) -> list[tuple[int, int, str]]:
    """Replacements (start, end, new text) that turn a value into a calibrated one."""
    p = update.parameter
    low, high = (_number(v) for v in update.interval90)
    value, prior = (f"{_number(v)} {p.unit}" if p.unit != "1" else _number(v) for v in (update.value, p.prior_value))
    news = {"value": value, "prior": prior, "interval90": f"[{low}, {high}]"}
    if not isinstance(node, yaml.MappingNode):
        return [
            (node.start_mark.index, node.end_mark.index, "{" + ", ".join(f"{k}: {v}" for k, v in news.items()) + "}")
        ]
    edits = []
    for key, new in news.items():
        old = _entry(node, key)
        if old is not None:
            edits.append((old.start_mark.index, old.end_mark.index, new))
    missing = [f"{k}: {v}" for k, v in news.items() if _entry(node, k) is None]
    at, column = node.value[-1][1].end_mark.index, node.value[0][0].start_mark.column
    glue = ", " if node.flow_style else "\n" + " " * column
    return [*edits, (at, at, "".join(glue + m for m in missing))] if missing else edits


def _number(value: float) -> str:
    """Five digits: more than any calibration knows."""
    return f"{value:.5g}"


DIGITS = 5e-5  # relative: what `twin.calibration.calibrated_file` keeps of a value


@dataclass(frozen=True)
class Origin:
    """Where calibrated values come from: batches, when (ISO date and time), errors of the batches left out.

    `left_out_rms` by channel in the channel's unit, empty where no batch was left out.
    """

    batches: tuple[str, ...]
    when: str
    simulated: bool = False
    left_out_rms: dict[str, float] = field(default_factory=dict)
    words: str = ""


def check_writable(source: Path, network: Network) -> str:
    """The text of a machine file into which every free parameter of its network can be written.

    Worth calling before the work: what cannot be written need not be calibrated.

    Raises:
        InputError: the file cannot be read, or holds no value of its own for a free parameter.
    """
    try:
        text = source.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"machine file {source}: cannot be read ({error}); give the path of a .yml file") from None
    where = f"machine file {source}"
    free = [network.parameters[k] for k in network.free]
    own = _own_paths(text, where)
    with_values(text, {own.get(p.name, p.name): Update(p, p.value, (p.value, p.value)) for p in free}, where)
    return text


def calibrated_text(
    text: str, network: Network, values: dict[str, float], intervals: list[Interval], origin: Origin, where: str
) -> str:
    """The text of a machine file with the values (by parameter) and intervals of a calibration.

    Raises:
        WorkError: the new text does not read back as the same network with these values.
    """
    own = _own_paths(text, where)
    updates = {
        own.get(i.name, i.name): Update(network.parameters[network.index(i.name)], values[i.name], (i.low, i.high))
        for i in intervals
    }
    new = with_calibrated(with_values(text, updates, where), _lines(origin))
    try:
        again = compile_network(parse_machine(new, where))
    except InputError as error:
        raise WorkError(f"{where}: the calibrated file does not read back ({error}); nothing was written") from None
    for name, value in values.items():
        kept = again.parameters[again.index(name)].value
        if not math.isclose(kept, value, rel_tol=DIGITS * 2, abs_tol=1e-12):
            raise WorkError(f"{where}: {name} reads back as {kept:g} instead of {value:g}; nothing was written")
    return new


def _own_paths(text: str, where: str) -> dict[str, str]:
    machine = parse_machine(text, where)
    return own_paths(machine, twin_part(machine, where))


def write_file(path: Path, text: str, source: Path, overwrite: bool = False) -> None:
    """Put the text at `path` in one step; on any failure what stood there stays as it was.

    Raises:
        InputError: `path` is the machine file that was calibrated, or exists, and `overwrite` is not set.
        WorkError: the file cannot be written.
    """
    check_target(path, source, overwrite)
    try:
        write_atomic(path, text)
    except OSError as error:
        raise WorkError(f"{path}: cannot be written ({error}); what stood there is unchanged") from None


def check_target(path: Path, source: Path, overwrite: bool = False) -> None:
    """Raises InputError where `path` must not be written: the input itself, an existing file, or no folder."""
    if not path.parent.is_dir():
        raise InputError(f"{path}: no folder {path.parent}; make it, or give another file")
    if path.is_dir():
        raise InputError(f"{path}: is a folder, expected a file name ending in .yml")
    if overwrite or not path.exists():
        return
    same = source.exists() and path.samefile(source)
    what = "is the machine file to calibrate" if same else "exists"
    raise InputError(f"{path}: {what}; give another file, or ask to overwrite it")


def _lines(origin: Origin) -> str:
    """The mapping under `calibrated`, YAML."""
    rows: dict[str, object] = {"batches": list(origin.batches), "when": origin.when, "simulated": origin.simulated}
    if origin.left_out_rms:
        rows["left_out_rms"] = {k: float(f"{v:.3g}") for k, v in origin.left_out_rms.items()}
    if origin.words:
        rows["words"] = origin.words
    return "".join(f"{k}: {_yaml(v)}\n" for k, v in rows.items())


def _yaml(value: object) -> str:
    text = yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=10**6, allow_unicode=True)
    return text.removesuffix("...\n").strip()
