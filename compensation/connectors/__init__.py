"""Where samples come from and corrections go: files, standard streams, MQTT, OPC UA.

A connector is one class in one file and one line in `SOURCES` or `SINKS`, under the scheme of its addresses. The class
is called with the address and the machine. `PATH.csv` has the scheme ``.csv``, standard input and output have ``-``.
"""

from __future__ import annotations

from pathlib import Path

from compensation.connectors.messages import shown
from compensation.contracts import Sink, Source
from data.errors import InputError, closest
from data.machine import Machine
from data.registry import Registry

SOURCES = Registry(
    "source",
    {
        "-": "compensation.connectors.streams:StandardInput",
        ".csv": "compensation.connectors.streams:CsvSource",
        "mqtt": "compensation.connectors.mqtt:MqttSource",
        "mqtts": "compensation.connectors.mqtt:MqttSource",
        "opc.tcp": "compensation.connectors.opcua:OpcUaSource",
    },
)
SINKS = Registry(
    "sink",
    {
        "-": "compensation.connectors.streams:StandardOutput",
        ".csv": "compensation.connectors.streams:CsvSink",
        "mqtt": "compensation.connectors.mqtt:MqttSink",
        "mqtts": "compensation.connectors.mqtt:MqttSink",
        "opc.tcp": "compensation.connectors.opcua:OpcUaSink",
    },
)


def open_source(address: str, machine: Machine, *, follow: bool = True) -> Source:
    """The source at an address: ``-``, ``PATH.csv``, ``mqtt://HOST:PORT/PREFIX`` or ``opc.tcp://HOST:PORT/PATH?nodes=``.

    With `follow` a CSV file is read as it grows; without, the source ends at the end of the file.

    Raises:
        InputError: an unknown scheme, an unusable address, or `follow=False` for a source without an end.
    """
    scheme = _scheme(address, SOURCES)
    source: Source
    if follow or scheme == "-":  # standard input ends by itself
        source = SOURCES[scheme](address, machine)
    elif scheme == ".csv":
        source = SOURCES[scheme](address, machine, follow=False)
    else:
        raise InputError(f"source {shown(address)}: a live source has no end; give PATH.csv or - for a replay")
    return source


def open_sink(address: str, machine: Machine) -> Sink:
    """The sink at an address: the same forms as for `open_source`.

    Raises:
        InputError: an unknown scheme or an unusable address.
    """
    sink: Sink = SINKS[_scheme(address, SINKS)](address, machine)
    return sink


def _scheme(address: str, registry: Registry) -> str:
    """The registry's key for an address."""
    before, separator, _ = address.partition("://")
    scheme = address if address == "-" else before.lower() if separator else Path(address).suffix.lower()
    if scheme not in registry:
        raise InputError(
            f"{registry.kind} {shown(address)}: unknown scheme or file extension {scheme!r}: "
            f"{closest(scheme, registry)}; give -, PATH.csv, mqtt://HOST:PORT/PREFIX or opc.tcp://HOST:PORT/PATH"
        )
    return scheme
