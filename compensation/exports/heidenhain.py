"""Export: compensation words and expansion values in the style of Heidenhain controls."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from compensation.exports.base import AxisModel, Export
from compensation.exports.straight_line import (
    NOT_TESTED,
    StraightLineExport,
    commented,
    formula_lines,
    formulas,
    input_names,
    plc_lines,
    warnings,
)

MOST_WORD_UM = 32_767.0  # a word is a signed 16-bit number of µm
MOST_RATE_UM_PER_S = 1.0  # rate at which older controls follow a word
STEEL_PER_K = 11.5e-6  # expansion of steel, to compare with


class HeidenhainExport(StraightLineExport):
    """A word in µm for each axis from the PLC, and expansions in 1/K for the kinematics where there is a slope."""

    key: ClassVar[str] = "heidenhain"
    summary: ClassVar[str] = "straight line in the style of Heidenhain: words in um for axes, expansion in 1/K"
    suffix: ClassVar[str] = "_heidenhain.txt"

    def files(self, export: Export) -> dict[str, str | bytes]:
        """Raises WorkError where a program is no straight line after all."""
        head = [
            *export.heading(),
            "",
            NOT_TESTED,
            f"A word is a whole number of um from -{MOST_WORD_UM:.0f} to {MOST_WORD_UM:.0f}; older controls follow it "
            f"at {MOST_RATE_UM_PER_S:g} um/s.",
        ]
        return {f"{export.stem}{self.suffix}": "\n\n".join([commented(head, ";"), *map(_axis, export.axes)]) + "\n"}


def _axis(a: AxisModel) -> str:
    name, p, lines = a.axis.upper(), a.program, formulas(a)
    rate = min(a.limits.rate_um_per_s, MOST_RATE_UM_PER_S)
    most = min(a.limits.max_offset_um, MOST_WORD_UM)
    head = [f"Axis {name}", *formula_lines(a), *warnings(a, lines, MOST_WORD_UM, "the range of a word")]
    if a.limits.max_offset_um > MOST_WORD_UM:
        head.append(f"WARNING: axis {name}: max_offset_um is larger than a word can hold; it is cut at {most:.0f} um")
    if rate < a.limits.rate_um_per_s:
        head.append(f"WARNING: axis {name}: the rate limit is cut from {a.limits.rate_um_per_s:g} to {rate:g} um/s")
    data = [f"COMP {name} UNIT um MIN {-most:.0f} MAX {most:.0f} RATE {rate:g} VALUE 0"]
    writes = [f"write COMP[{name}] := ROUND(LIMIT({-most:.0f}, offset_um, {most:.0f}))   // um"]
    if p.along:
        head.append(f"EXPANSION: tan beta for 1 K, negative of the model's; steel expands by {STEEL_PER_K:g} 1/K.")
        for channel, now in zip(input_names(a), lines[1].now, strict=True):
            if now:
                data.append(f"EXPANSION {name} SENSOR {channel} REFERENCE {p.reference_mm:g} VALUE {-now / 1000.0:.6g}")
        rest = lines[1].constant != 0.0 or not np.allclose(lines[1].now, -lines[1].first)
        if rest:
            head.append(f"WARNING: axis {name}: tan beta is not 0 without a rise; EXPANSION leaves that part out")
        writes.append("EXPANSION acts on the rise since the first row; slope_um_per_m above shows its sum")
    code = ["PLC, cyclically (pseudo code; cycle_s is its cycle):", *plc_lines(a, rate, writes)]
    words = "\n".join(data)
    return f"{commented(head, ';')}\n{words}\n{commented(code, ';')}"
