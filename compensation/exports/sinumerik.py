"""Export: machine and setting data of SINUMERIK temperature compensation, fed by the receiver."""

from __future__ import annotations

from typing import ClassVar

from compensation.exports.base import AxisModel, Export, Exporter, wrapped

CYCLE_S = 0.004  # interpolation cycle that the file assumes: MD10071 shows the control's own
MOST_VELOCITY_MM_PER_MIN = 10_000.0  # axis velocity that the file assumes: MD32000 shows the axis' own
_LEAST_FACTOR, _MOST_FACTOR = 1e-6, 0.1  # what MD32760 is kept within; the control accepts up to 0.1
_MARGIN = 1.2  # MD32760 also caps tan β, which must not be cut in the trained region


class SinumerikExport(Exporter):
    """MD32750, MD32760, SD43900, SD43910 and SD43920 of each axis, and what the PLC writes into them.

    Source: Siemens, SINUMERIK Function Manual Extended Functions, K3 Compensations (temperature compensation).
    """

    key: ClassVar[str] = "sinumerik"
    summary: ClassVar[str] = "data of SINUMERIK temperature compensation (MD32750, SD43900 ...) fed by the receiver"
    suffix: ClassVar[str] = "_sinumerik.txt"

    def files(self, export: Export) -> dict[str, str | bytes]:
        head = [
            *export.heading(),
            "",
            "This file has not been run on a control: compare every identifier with the manual of your control, and "
            "the sign with a trial value of 10 um, before you use it.",
            "dK(P) = K0 + tan beta * (P - P0): SD43900 is K0 in mm, SD43910 tan beta, SD43920 P0 in mm.",
            "SIGN = 1 where the control adds dK to the set point, as this file assumes; else -1.",
            f"Assumed: interpolation cycle {CYCLE_S:g} s (MD10071), axis velocity {MOST_VELOCITY_MM_PER_MIN:g} "
            "mm/min (MD32000). MD32760 is a share of that velocity.",
            "The PLC writes the outputs of the receiver (export receiver), which limits, holds and fades; never a "
            "received or computed value itself.",
        ]
        parts = [_commented(head), *map(_axis, export.axes)]
        return {f"{export.stem}{self.suffix}": "\n\n".join(parts) + "\n"}


def _commented(lines: list[str]) -> str:
    return "\n".join(f"; {line}".rstrip() for line in wrapped(lines))


def _axis(a: AxisModel) -> str:
    p, name = a.program, a.axis.upper()
    factor = _factor(a)
    most_um = factor * MOST_VELOCITY_MM_PER_MIN * 1000.0 / 60.0 * CYCLE_S
    data = [
        (f"$MA_TEMP_COMP_TYPE[{name}] = {'3' if p.along else '1'}", "MD32750: bit 0 offset, bit 1 slope"),
        (f"$MA_COMP_ADD_VELO_FACTOR[{name}] = {factor:.9f}", f"MD32760: at most {most_um:.4g} um per cycle"),
        (f"$SA_TEMP_COMP_ABS_VALUE[{name}] = 0.0", "SD43900: K0 in mm, from the PLC"),
    ]
    writes = [f"SD43900[{name}] := SIGN * offset_um / 1000.0, in mm"]
    if p.along:
        data += [
            (f"$SA_TEMP_COMP_SLOPE[{name}] = 0.0", "SD43910: tan beta in mm/mm, from the PLC"),
            (f"$SA_TEMP_COMP_REF_POSITION[{name}] = {p.reference_mm:g}", "SD43920: P0 in mm"),
        ]
        writes.append(f"SD43910[{name}] := SIGN * slope_um_per_m / 1000000.0, in mm/mm")
    lines = "\n".join(f"{text} ; {note}" for text, note in data)
    code = ["From the receiver, in every cycle of the PLC:", *(f"  {text}" for text in writes)]
    return f"{_commented([f'Axis {name}'])}\n{lines}\n{_commented(code)}"


def _factor(a: AxisModel) -> float:
    """MD32760: the rate limit, raised where it would cut tan β."""
    rate = a.limits.rate_um_per_s * 60.0 / 1000.0 / MOST_VELOCITY_MM_PER_MIN
    slope = _MARGIN * a.max_slope_um_per_m * 1e-6 if a.program.along else 0.0
    return min(max(rate, slope, _LEAST_FACTOR), _MOST_FACTOR)
