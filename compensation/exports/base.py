"""What an export states, and the base class of the exports."""

from __future__ import annotations

import re
import textwrap
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from math import inf, isfinite
from pathlib import Path
from typing import Any, ClassVar, final

import numpy as np

from compensation.core import LIMITS
from compensation.safety import Limits
from data.errors import InputError
from data.files import check_folder, staged
from models.program import Program
from models.selection.trust import LEAST_WIDTH

SIGN = (
    "The model gives the error in um. The control adds the negative of the error: offset_um = -error_um, limited in "
    "size and rate."
)
_LEAST_LEVER_M = 1e-3  # a slope acts over at least 1 mm, so that its limit stays finite
_LINE = 110
MOST = 1e30  # a larger value is no number: NaN, infinity, or a model that has diverged


@dataclass(frozen=True)
class ExportedAxis:
    """The model of one error channel.

    Attributes:
        axis: error channel, such as ``z``.
        program: its outputs are the error in µm and, with `along`, the slope in µm/mm.
        region: channel → least and greatest trained value as recorded (not as a rise), in the program's unit.
        limits: of the correction.
        remark: on the model; empty: none.
        plausible: channel → least and greatest value that it can have, ±inf where an end is not known.
        trust: share of the correction that the distance from the trained region leaves, see `exports.region`, over
            channels of the program; None: 1.
        checks: of the sensors, see `exports.region`, over channels of the program; None: none but their range.
    """

    axis: str
    program: Program
    region: Mapping[str, tuple[float, float]]
    limits: Limits
    remark: str = ""
    plausible: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    trust: Program | None = None
    checks: Program | None = None

    @property
    def lever_m(self) -> float:
        """Greatest |P − P0| at which the limits hold for the slope's part, m: of the trained travel, else 1 m."""
        p = self.program
        if p.along not in self.region:
            return 1.0
        return max(*(abs(end - p.reference_mm) / 1000.0 for end in self.region[p.along]), _LEAST_LEVER_M)

    @property
    def max_slope_um_per_m(self) -> float:
        return self.limits.max_offset_um / self.lever_m

    @property
    def sent(self) -> list[tuple[str, str, float]]:
        """What the control adds: name, unit, and µm at the tool for one unit of it, at the lever for a slope."""
        slope = [("slope_um_per_m", "um/m", self.lever_m)] if self.program.along else []
        return [("offset_um", "um", 1.0), *slope]

    @property
    def output_units(self) -> Mapping[str, str]:
        return {"error_um": "um"} | ({"slope_um_per_mm": "um/mm"} if self.program.along else {})

    def usable(self) -> list[tuple[float, float]]:
        """Least and greatest value of each channel with which the correction acts; ±inf for one without any.

        A value further outside the trained region than the region is wide counts as a fault of the sensor: up to there
        the model extrapolates, as it does in `models.selection.trust`. Narrow regions count as 5 K, 1000 rpm or 1000
        mm/min wide.
        """
        out = []
        for name, unit in zip(self.program.channels, self.program.units, strict=True):
            low, high = self.region.get(name, (-inf, inf))
            width = max(high - low, LEAST_WIDTH.get(unit, 0.0))
            least, most = self.plausible.get(name, (-inf, inf))
            out.append((max(low - width, least), min(high + width, most)))
        return out

    def described(self) -> dict[str, Any]:
        """Everything but the operations as plain data; keys name units."""
        p = self.program
        inputs = [
            {
                "channel": name,
                "unit": unit,
                "required": bool(required),
                "trained": list(map(float, self.region[name])) if name in self.region else None,
                "usable": [end if isfinite(end) else None for end in (low, high)],
            }
            for name, unit, required, (low, high) in zip(p.channels, p.units, p.required, self.usable(), strict=True)
        ]
        position = {"along": p.along, "reference_mm": p.reference_mm, "line": _line(p)} if p.along else None
        limits = {
            **{name: float(getattr(self.limits, name)) for name in LIMITS},
            "max_slope_um_per_m": self.max_slope_um_per_m if p.along else None,
        }
        return {
            "axis": self.axis,
            "remark": self.remark,
            "inputs": inputs,
            "outputs": [{"name": name, "unit": unit} for name, unit in self.output_units.items()],
            "position": position,
            "step_s": p.step_s,
            "trained_region": {name: list(map(float, ends)) for name, ends in self.region.items()},
            "limits": limits,
            "trust": self.trust.as_plain() if self.trust is not None else None,
            "checks": self.checks.as_plain() if self.checks is not None else None,
            "fallback": _fallback(self),
        }


@dataclass(frozen=True)
class Export:
    """A model of a machine with what its files state.

    Attributes:
        machine: name of the machine.
        model: ``NAME@ALIAS`` or the folder of the model.
        version: of the model.
        digest: sha256 of the stored model.
        created: ISO time at which the export was made.
        simulated: the model was trained on simulated recordings.
        axes: one model for each error channel.
    """

    machine: str
    model: str
    version: str
    digest: str
    created: str
    simulated: bool
    axes: tuple[ExportedAxis, ...]

    @property
    def stem(self) -> str:
        """The machine's name as an identifier: begins the names of files and functions."""
        return identifiers([self.machine])[0]

    def described(self) -> dict[str, Any]:
        """What applies to all axes, as plain data."""
        return {
            "machine": self.machine,
            "model": self.model,
            "version": self.version,
            "sha256": self.digest,
            "created": self.created,
            "simulated": "SIMULATED" if self.simulated else "",
            "sign": SIGN,
        }

    def heading(self, axes: Sequence[ExportedAxis] | None = None) -> list[str]:
        """The statement as lines of ASCII text for a comment, at most 110 characters each."""
        lines = [
            f"thermodrift: thermal error of machine {self.machine}",
            *["SIMULATED: trained on simulated recordings; not for a real machine."] * self.simulated,
            *(f"axis {a.axis}: {a.remark}" for a in self.axes if a.remark),
            f"model {self.model}, version {self.version}, created {self.created}",
            f"sha256 {self.digest}",
            f"Sign: {SIGN}",
        ]
        for axis in self.axes if axes is None else axes:
            lines += ["", *_axis_lines(axis)]
        return wrapped(lines)


class Exporter(ABC):
    """Writes an export. To add one: a class below this and a line in `compensation/exports/__init__.py`."""

    key: ClassVar[str]
    summary: ClassVar[str]
    suffix: ClassVar[str]  # how the names of its files end, behind the machine's name

    @abstractmethod
    def files(self, export: Export) -> dict[str, str | bytes]:
        """Names and content of the files; `write` has checked the export before."""

    def refusal(self, export: Export) -> str | None:
        """Why the target cannot express one of the programs, None where it can."""
        return None

    @final
    def write(self, export: Export, folder: Path) -> list[Path]:
        """Writes the files into a folder, over earlier ones of the same names, all or none.

        Raises:
            InputError: the export states something unusable, the target cannot express one of its programs, or the
                folder cannot be written.
            WorkError: a file cannot be written.
        """
        check_export(export)
        reason = self.refusal(export)
        if reason is not None:
            from compensation.exports import EXPORTS

            those = [key for key, other in EXPORTS.items() if other().refusal(export) is None]
            raise InputError(f"export {self.key}: {reason}; these exports can: {', '.join(those)}")
        content = self.files(export)
        paths = [folder / name for name in content]
        check_folder(folder, paths, overwrite=True)
        with staged(folder, list(content)) as scratch:
            for name, text in content.items():
                (scratch / name).write_bytes(text if isinstance(text, bytes) else text.encode())
        return paths


def check_export(export: Export) -> None:
    """Raises InputError where an export states something that no file can."""
    where = f"export of {export.machine}"
    names = [a.axis for a in export.axes]
    if not names or len(set(names)) != len(names):
        raise InputError(f"{where}: got axes {names}; expected at least one, each once")
    for a in export.axes:
        for name, (low, high) in a.region.items():
            if not (isfinite(low) and isfinite(high) and low <= high):
                raise InputError(
                    f"{where}: axis {a.axis}: trained region of {name} is {low:g} to {high:g}; train again"
                )
        if len(a.program.outputs) != len(a.output_units):
            raise InputError(
                f"{where}: axis {a.axis}: the program has {len(a.program.outputs)} outputs; expected the error"
                f"{' and its slope along ' + a.program.along if a.program.along else ''}"
            )
        for number, n in enumerate(a.program.nodes):
            if not all(np.isfinite(values).all() for values in n.data.values()):
                raise InputError(f"{where}: axis {a.axis}: operation {number} ({n.op}) is not finite; train again")


def stale_rows(export: Export) -> str | None:
    """Why a file that runs the models cannot, where a row comes later than the one before is stale."""
    for a in export.axes:
        if a.limits.stale_s < a.program.step_s:
            return (
                f"axis {a.axis} has stale_s {a.limits.stale_s:g} s, below its step of {a.program.step_s:g} s; give "
                "--stale-s of at least three steps"
            )
    return None


def ascii_text(text: str) -> str:
    """Text that can stand in a comment of every target: ASCII, one line, without a comment's marks."""
    for mark, plain in {"µ": "u", "μ": "u", "°": "deg", "·": "*", "×": "x", "−": "-", "–": "-", "²": "^2"}.items():
        text = text.replace(mark, plain)
    text = " ".join(text.encode("ascii", "replace").decode().split())
    return re.sub(r"\*(?=[/)])|[/(](?=\*)|\?(?=\?)", lambda m: f"{m[0]} ", text)


def identifiers(names: Iterable[str]) -> list[str]:
    """A distinct identifier for each name: ASCII letters, digits and single _; distinct without regard to case."""
    out: list[str] = []
    for name in names:
        base = re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_")
        base = base if base[:1].isalpha() else f"m_{base}".rstrip("_")
        unique, count = base, 1
        while unique.casefold() in {o.casefold() for o in out}:
            count += 1
            unique = f"{base}_{count}"
        out.append(unique)
    return out


def wrapped(lines: Iterable[str]) -> list[str]:
    """Lines as ASCII of at most 110 characters; continuations are indented."""
    out = []
    for line in lines:
        indent = line[: len(line) - len(line.lstrip())]
        text = ascii_text(line)
        out += textwrap.wrap(text, _LINE, initial_indent=indent, subsequent_indent=f"{indent}  ") or [""]
    return out


def _axis_lines(a: ExportedAxis) -> list[str]:
    p = a.program
    lines = [f"Axis {a.axis}: one row every {p.step_s:g} s", "Inputs:"]
    for name, unit, required, usable in zip(p.channels, p.units, p.required, a.usable(), strict=True):
        need = "required" if required else "bridged at its last value where it is missing"
        ends = a.region.get(name)
        trained = f"trained {ends[0]:.6g} to {ends[1]:.6g}" if ends else "no trained region"
        lines.append(f"  {name} in {unit}, {need}, {trained}, usable {usable[0]:.6g} to {usable[1]:.6g}")
    if not p.channels:
        lines.append("  none")
    others = [f"{n} {low:.6g} to {high:.6g}" for n, (low, high) in a.region.items() if n not in p.channels]
    lines += [f"  also in the trained region: {', '.join(others)}"] if others else []
    lines += ["Outputs:", "  error_um in um" + (f" at P0 = {p.reference_mm:g} mm of {p.along}" if p.along else "")]
    if p.along:
        lines.append(f"  slope_um_per_mm in um/mm: {_line(p)}")
    step = f", {a.limits.step_um:g} um from one transmission to the next"
    slope = f", |slope| <= {a.max_slope_um_per_m:.6g} um/m" if p.along else ""
    lines.append(f"Limits: |offset| <= {a.limits.max_offset_um:g} um{slope}, {a.limits.rate_um_per_s:g} um/s{step}")
    return [*lines, f"Fallback: {_fallback(a)}"]


def _line(p: Program) -> str:
    return f"error at P = error_um + slope_um_per_mm * (P - {p.reference_mm:g} mm), P in mm of {p.along}"


def _fallback(a: ExportedAxis) -> str:
    fails = "missing, not usable, frozen or stepping" if a.checks is not None else "missing or not usable"
    return (
        f"a required input that is {fails}, or {a.limits.stale_s:g} s without a row: hold the offset for "
        f"{a.limits.hold_s:g} s, then fade to 0 at {a.limits.rate_um_per_s:g} um/s; valid for "
        f"{a.limits.warm_up_s:g} s before it acts"
    )
