"""Export: absolute offsets in the style of FANUC thermal growth compensation."""

from __future__ import annotations

from typing import ClassVar

from compensation.exports.base import AxisModel, Export
from compensation.exports.straight_line import (
    NOT_TESTED,
    StraightLineExport,
    commented,
    formula_lines,
    formulas,
    plc_lines,
    warnings,
)

UNIT_UM = 1.0  # least input increment that the file assumes
ALARM_UNITS = 9999  # an offset of so many units, or more, is an alarm


class FanucExport(StraightLineExport):
    """A signed absolute offset for each axis from the PLC; the control has no slope along the axis."""

    key: ClassVar[str] = "fanuc"
    summary: ClassVar[str] = "offsets in the style of FANUC thermal growth compensation: signed, absolute, no slope"
    suffix: ClassVar[str] = "_fanuc.txt"
    slope: ClassVar[bool] = False

    def files(self, export: Export) -> dict[str, str | bytes]:
        """Raises WorkError where a program is no straight line after all."""
        head = [
            *export.heading(),
            "",
            NOT_TESTED,
            f"An offset is signed and absolute, in units of {UNIT_UM:g} um; |offset| >= {ALARM_UNITS} units: alarm.",
        ]
        parts = [commented(head, "%"), *map(_axis, export.axes)]
        return {f"{export.stem}{self.suffix}": "\n\n".join(parts) + "\n"}


def _axis(a: AxisModel) -> str:
    name = a.axis.upper()
    largest = (ALARM_UNITS - 1) * UNIT_UM
    most = min(a.limits.max_offset_um, largest)
    head = [f"Axis {name}", *formula_lines(a), *warnings(a, formulas(a), largest, "the alarm limit")]
    if a.limits.max_offset_um > largest:
        head.append(f"WARNING: axis {name}: max_offset_um would be an alarm; the offset is cut at {most:.0f} um")
    writes = [f"write OFFSET[{name}] := ROUND(LIMIT({-most:.0f}, offset_um, {most:.0f}) / {UNIT_UM:g})   // units"]
    code = [
        "PLC, cyclically (pseudo code; cycle_s is its cycle):",
        *plc_lines(a, a.limits.rate_um_per_s, writes),
    ]
    line = f"OFFSET {name} UNIT {UNIT_UM:g} um LIMIT {most / UNIT_UM:.0f} ALARM {ALARM_UNITS} VALUE 0"
    return f"{commented(head, '%')}\n{line}\n{commented(code, '%')}"
