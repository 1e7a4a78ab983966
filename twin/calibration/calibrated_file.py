"""A calibrated machine file: the old one's text with the new values, read back before it replaces anything."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from data.errors import InputError, WorkError
from data.files import write_atomic
from data.machine import parse_machine
from data.yaml_edit import YamlText
from twin.calibration.identifiability import Interval
from twin.compile import compile_network, own_paths
from twin.network import Network
from twin.quantity import Parameter
from twin.schema import Calibrated, twin_part


@dataclass(frozen=True)
class Update:
    """One parameter's new value and 90 % interval, in the parameter's unit."""

    parameter: Parameter
    value: float
    interval90: tuple[float, float]


def with_values(text: str, updates: Mapping[str, Update], where: str) -> str:
    """The machine file's text with calibrated values; each keeps its prior's centre next to it.

    `updates` by parameter path ("links.shaft-front.conductance").

    Raises:
        InputError: a path that the text does not hold as a value of its own (an anchor, a mechanism's default).
    """
    document = YamlText(text)
    put_values(document, updates, where)
    return str(document)


def put_values(document: YamlText, updates: Mapping[str, Update], where: str) -> None:
    """`with_values` in a text that is edited further. Raises as that does."""
    for path, update in updates.items():
        steps, missing = held_steps(document, path)
        if missing and not (missing == ["conductance"] and document.get([*steps, "value"]) is not None):
            raise InputError(f"{where}: twin.{path} is no value with a spread in the file; write it there")
        p = update.parameter
        value, prior = (v if p.unit == "1" else f"{v:g} {p.unit}" for v in map(kept, (update.value, p.prior_value)))
        new = {"value": value, "prior": prior, "interval90": [kept(v) for v in update.interval90]}
        if isinstance(document.get(steps), Mapping):
            for key, given in new.items():
                document.set(steps, key, given)
        else:
            document.set(steps[:-1], steps[-1], new)


def with_calibrated(text: str, origin: Calibrated) -> str:
    """The text with the twin part's `calibrated` entry, at its beginning, replaced: no empty rows, three digits."""
    rows = {"batches": list(origin.batches), "when": origin.when, "simulated": origin.simulated}
    rms = {k: float(f"{v:.3g}") for k, v in origin.left_out_rms.items()}
    more = {"left_out_rms": rms, "words": origin.words}
    document = YamlText(text)
    entry = rows | {k: v for k, v in more.items() if v}
    document.set(["twin"], "calibrated", entry, order=["calibrated"], blocks=1)
    return str(document)


def held_steps(document: YamlText, path: str) -> tuple[list[str], list[str]]:
    """The keys that lead to a parameter's path ("errors.z.chain[0].length") as far as the text holds it, and the rest.

    Parameters of a mechanism are a level deeper than their path says, a lone conductance a level higher.
    """
    out, left = ["twin"], path.replace("[", ".").replace("]", "").split(".")
    while left:
        deeper = next((d for d in (left[:1], ["parameters", left[0]]) if document.get([*out, *d]) is not None), None)
        if deeper is None:
            break
        out, left = out + deeper, left[1:]
    return out, left


def kept(value: float) -> float:
    """Five digits: more than any calibration knows."""
    rounded = float(f"{value:.5g}")
    return int(rounded) if rounded.is_integer() and abs(rounded) < 1e9 else rounded


DIGITS = 5e-5  # relative: what `twin.calibration.calibrated_file` keeps of a value


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
    text: str, network: Network, values: dict[str, float], intervals: list[Interval], origin: Calibrated, where: str
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
    new = with_calibrated(with_values(text, updates, where), origin)
    try:
        machine = parse_machine(new, where)
        again = compile_network(machine)
    except InputError as error:
        raise WorkError(f"{where}: the calibrated file does not read back ({error}); nothing was written") from None
    if machine.model_copy(update={"twin": None}) != parse_machine(text, where).model_copy(update={"twin": None}):
        raise WorkError(f"{where}: writing would change more than the twin part; nothing was written")
    for name, value in values.items():
        kept = again.parameters[again.index(name)].value
        if not math.isclose(kept, value, rel_tol=DIGITS * 2, abs_tol=1e-12):
            raise WorkError(f"{where}: {name} reads back as {kept:g} instead of {value:g}; nothing was written")
    return new


def _own_paths(text: str, where: str) -> dict[str, str]:
    machine = parse_machine(text, where)
    return own_paths(machine, twin_part(machine, where))


def write_file(path: Path, text: str, source: Path, overwrite: bool = False) -> None:
    """Put the text at `path` in one step; on any failure the previous content stays.

    Raises:
        InputError: `path` is the machine file that was calibrated, or exists, and `overwrite` is not set.
        WorkError: the file cannot be written.
    """
    check_target(path, source, overwrite)
    try:
        write_atomic(path, text)
    except OSError as error:
        raise WorkError(f"{path}: cannot be written ({error}); the previous content is unchanged") from None


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
