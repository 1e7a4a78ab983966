"""Export: the receiver at the control, which moves what arrives within the limits and outlives what sends it."""

from __future__ import annotations

import uuid
from typing import ClassVar

from compensation.exports import c99, structured_text
from compensation.exports.base import MOST, Export, ExportedAxis, Exporter, identifiers, wrapped
from compensation.exports.lowering import Writer
from compensation.exports.structured_text import StructuredText, function_block

_HOW = (
    "Wire the received correction to this, and its outputs to the offset of the control; never the received value "
    "itself. A heartbeat that changes says that the sender is alive; without one for stale_s, or with a value that is "
    "not valid, the outputs are held, then fade to 0 at the limited rate."
)


class ReceiverExport(Exporter):
    """The state machine of `compensation.core` behind a received correction, for each axis as structured text and as a
    TwinCAT POU, and for all axes as C99."""

    key: ClassVar[str] = "receiver"
    summary: ClassVar[str] = "receiver for a live correction: structured text, TwinCAT and C; rate, step, hold and fade"
    suffix: ClassVar[str] = "_receiver.st, .c, .h, _AXIS.TcPOU"

    def files(self, export: Export) -> dict[str, str | bytes]:
        names = identifiers(a.axis for a in export.axes)
        stem, out = f"{export.stem}_receiver", dict[str, str | bytes]()
        blocks = []
        for a, name in zip(export.axes, names, strict=True):
            block = f"FB_{stem}_{name}"
            blocks.append(_block(export, a, block))
            out[f"{stem}_{name}.TcPOU"] = _twincat(block, blocks[-1])
        return {f"{stem}.st": "\n".join(blocks), **out, f"{stem}.h": _header(export), f"{stem}.c": _source(export)}


def _block(export: Export, a: ExportedAxis, name: str) -> str:
    w = Writer(StructuredText(), indent=0)
    finite = [structured_text.within(f"received_{output}", -MOST, MOST) for output, _, _ in a.sent]
    w.put("received_ok", " AND ".join(["valid", *finite]))
    w.put("alive", "core_begun AND (heartbeat <> last_heartbeat)")
    w.put("last_heartbeat", "heartbeat")
    w.put("usable", "SEL(received_ok AND alive, 0.0, 1.0)")
    w.put("faulty", "SEL(received_ok, 1.0, 0.0)")
    with w.when("received_ok"):
        for k, (output, _, um) in enumerate(a.sent):
            factor = "" if um == 1.0 else f" * {structured_text.real(um)}"
            w.put(f"{w.array('wanted_um', len(a.sent))}[{k}]", f"received_{output}{factor}")
    structured_text.move(w, a)
    given = [
        *structured_text.MOVED,
        "heartbeat : DINT; (* a counter of the sender *)",
        "valid : BOOL; (* FALSE where the connection reports a fault *)",
        *(f"received_{output} : LREAL; (* {unit} *)" for output, unit, _ in a.sent),
    ]
    own = ["last_heartbeat : DINT;", "received_ok : BOOL;", "alive : BOOL;"]
    heading = [*export.heading([a]), "", f"Receiver. Call this in every cycle. {_HOW}"]
    return function_block(name, w, given, structured_text.sent_outputs(a), own, heading)


def _twincat(name: str, block: str) -> str:
    """The same block as the file of a TwinCAT project: declaration and body apart."""
    block = block.replace("]]>", "]] >")  # which would end the section
    at = block.rindex("END_VAR") + len("END_VAR")
    body = block[at:].replace("END_FUNCTION_BLOCK", "").strip()
    number = uuid.uuid5(uuid.NAMESPACE_URL, f"thermodrift/{name}")
    return f"""<?xml version="1.0" encoding="utf-8"?>
<TcPlcObject Version="1.1.0.1">
  <POU Name="{name}" Id="{{{number}}}" SpecialFunc="None">
    <Declaration><![CDATA[{block[:at]}
]]></Declaration>
    <Implementation>
      <ST><![CDATA[{body}
]]></ST>
    </Implementation>
  </POU>
</TcPlcObject>
"""


def _header(export: Export) -> str:
    name, upper = export.stem, export.stem.upper()
    statement = "\n".join(f" * {line}".rstrip() for line in [*export.heading(), "", *wrapped([_HOW])])
    axes = "\n".join(
        f"#define {upper}_AXIS_{n.upper()} {k}" for k, n in enumerate(identifiers(a.axis for a in export.axes))
    )
    return f"""/*
{statement}
 */
#ifndef {upper}_RECEIVER_H
#define {upper}_RECEIVER_H

#define {upper}_N_AXES {len(export.axes)}
{axes}

/* Call this in every cycle with the time since the last call in s. received_...[{upper}_N_AXES] is the correction as it
 * came, um and um/m; heartbeat a counter of the sender; valid 0 where the connection reports a fault. offset_um[] and
 * slope_um_per_m[] are what the control adds. */
void {name}_receive(double elapsed_s, const double received_offset_um[], const double received_slope_um_per_m[],
                    long heartbeat, int valid, double offset_um[], double slope_um_per_m[]);

{c99.SHARED.format(name=name)}
#endif
"""


def _source(export: Export) -> str:
    name, lines, at = export.stem, [], 0
    for k, a in enumerate(export.axes):
        finite = [f"fabs(received_{output}[{k}]) <= {MOST!r}" for output, _, _ in a.sent]
        lines.append(f"    good = {' && '.join(['valid', *finite])};")
        for output, _, um in a.sent:
            lines.append(f"    take({at}, received_{output}[{k}]{'' if um == 1.0 else f' * {um!r}'}, good, alive);")
            at += 1
    taken = "\n".join(lines)
    statement = "\n".join(f" * {line}".rstrip() for line in export.heading(axes=()))
    return f"""/*
{statement}
 *
 * {name}_receiver.h states how to call this.
 */
#include "{name}_receiver.h"

#include <math.h>

{c99.move_source(export, "static void move")}
static void take(int place, double value_um, int good, int alive)
{{
    wanted_um[place] = good ? value_um : 0.0;
    usable[place] = good && alive ? 1.0 : 0.0;
    faulty[place] = good ? 0.0 : 1.0;
}}

void {name}_receive(double elapsed_s, const double received_offset_um[], const double received_slope_um_per_m[],
                    long heartbeat, int valid, double offset_um[], double slope_um_per_m[])
{{
    static long last_heartbeat;
    int alive = core_begun && heartbeat != last_heartbeat;
    int good;
    (void)received_slope_um_per_m;
    last_heartbeat = heartbeat;
{taken}
    move(elapsed_s, offset_um, slope_um_per_m);
}}
"""
