"""Export: machine and setting data of SINUMERIK temperature compensation, fed by the receiver."""

from __future__ import annotations

from typing import ClassVar

from compensation.exports.base import Export, ExportedAxis, Exporter, wrapped


class SinumerikExport(Exporter):
    """MD32750, SD43900, SD43910 and SD43920 of each axis, and what the PLC writes into them.

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
            "The PLC writes the outputs of the receiver (export receiver), which limits, holds and fades; never a "
            "received or computed value itself.",
        ]
        parts = [_commented(head), *map(_axis, export.axes)]
        return {f"{export.stem}{self.suffix}": "\n\n".join(parts) + "\n"}


def _commented(lines: list[str]) -> str:
    return "\n".join(f"; {line}".rstrip() for line in wrapped(lines))


def _axis(a: ExportedAxis) -> str:
    p, name = a.program, a.axis.upper()
    data = [
        (f"$MA_TEMP_COMP_TYPE[{name}] = {'3' if p.along else '1'}", "MD32750: bit 0 offset, bit 1 slope"),
        (f"$SA_TEMP_COMP_ABS_VALUE[{name}] = 0.0", "SD43900: K0 in mm, from the PLC"),
    ]
    head, writes = [f"Axis {name}"], [f"SD43900[{name}] := SIGN * offset_um / 1000.0, in mm"]
    if p.along:
        data += [
            (f"$SA_TEMP_COMP_SLOPE[{name}] = 0.0", "SD43910: tan beta in mm/mm, from the PLC"),
            (f"$SA_TEMP_COMP_REF_POSITION[{name}] = {p.reference_mm:g}", "SD43920: P0 in mm"),
        ]
        head.append(f"MD32760 caps tan beta as well: keep it above {a.max_slope_um_per_m * 1e-6:.3g}.")
        writes.append(f"SD43910[{name}] := SIGN * slope_um_per_m / 1000000.0, in mm/mm")
    lines = "\n".join(f"{text} ; {note}" for text, note in data)
    code = ["From the receiver, in every cycle of the PLC:", *(f"  {text}" for text in writes)]
    return f"{_commented(head)}\n{lines}\n{_commented(code)}"
