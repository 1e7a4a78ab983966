"""A calibrated machine file: the old one's text with the new values, read back before it replaces anything."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import yaml

from data.atomic_file import write_atomic
from data.errors import InputError, WorkError
from data.machine import parse_machine
from twin.calibration.identifiability import Interval
from twin.calibration.rewrite import Update, with_calibrated, with_values
from twin.compile import compile_network
from twin.compiling.own_paths import own_paths
from twin.network import Network
from twin.schema import twin_part

DIGITS = 5e-5  # relative: what `twin.calibration.rewrite` keeps of a value


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
