"""Samples from a real OPC UA server in another process, and corrections to it; a server that restarts."""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import signal
import socket
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from compensation.connectors import open_sink, open_source
from compensation.connectors.opcua import OpcUaSink
from compensation.contracts import Correction
from data.errors import InputError, WorkError
from data.machine import Machine, parse_machine
from tests.compensation import links
from tests.compensation.links import TIMEOUT_S, eventually, taken

URI = "http://maker.example/plc"
MACHINE = links.MACHINE + "  x: {role: error, unit: um}\n"
NODES = f"""
interval_s: 0.1
values: {{front: "nsu={URI};s=Front", room: ns=2;s=Room}}
readings: {{z: ns=2;s=Probe}}
offsets_um: {{z: ns=2;s=Offset, x: "nsu={URI};s=OffsetX"}}
slopes_um_per_m: {{z: ns=2;s=Slope}}
states: {{z: ns=2;s=StateZ}}
reasons: {{z: ns=2;s=ReasonZ}}
state: ns=2;s=State
heartbeat: ns=2;s=Beat
valid_until_s: ns=2;s=Until
"""
CORRECTION = Correction(
    100.5, {"z": -12.25, "x": 0.5}, {"z": 3.5}, {"z": "active", "x": "hold"}, {"z": "provisional model"}
)


def serve(port: int, pipe: Any) -> None:
    """A control's server; a request on the pipe is (node, value to write, or None to read)."""
    asyncio.run(_serve(port, pipe))


async def _serve(port: int, pipe: Any) -> None:
    from asyncua import Server, ua

    server = Server()
    await server.init()
    server.set_endpoint(f"opc.tcp://127.0.0.1:{port}/plc")
    space = await server.register_namespace(URI)
    first: dict[str, tuple[Any, ua.VariantType]] = {
        "Front": (20.0, ua.VariantType.Double),
        "Room": (19, ua.VariantType.Int16),
        "Probe": (99.0, ua.VariantType.Float),
        "Offset": (0.0, ua.VariantType.Double),
        "OffsetX": (0.0, ua.VariantType.Float),
        "Slope": (0.0, ua.VariantType.Double),
        "StateZ": ("", ua.VariantType.String),
        "ReasonZ": ("", ua.VariantType.String),
        "State": ("", ua.VariantType.String),
        "Beat": (0, ua.VariantType.Byte),
        "Until": (0.0, ua.VariantType.Double),
        "ReadOnly": (0.0, ua.VariantType.Double),
    }
    nodes = {}
    for name, (value, kind) in first.items():
        nodes[name] = await server.nodes.objects.add_variable(ua.NodeId(name, space), name, value, kind)
        if name != "ReadOnly":
            await nodes[name].set_writable()
    async with server:
        pipe.send("started")
        while True:
            name, value = await asyncio.get_running_loop().run_in_executor(None, pipe.recv)
            if value is None:
                pipe.send(await nodes[name].read_value())
            elif value == "bad":
                bad = ua.DataValue(StatusCode=ua.StatusCode(ua.StatusCodes.BadSensorFailure))
                pipe.send(await server.write_attribute_value(nodes[name].nodeid, bad))
            else:
                pipe.send(await nodes[name].write_value(ua.Variant(value, first[name][1])))


class Control:
    """The server's process on a free port of this computer."""

    def __init__(self, folder: Path) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.nodes = folder / "nodes.yml"
        self.nodes.write_text(NODES)
        self.address = f"opc.tcp://127.0.0.1:{self.port}/plc?nodes={self.nodes}"
        self.start()

    def start(self) -> None:
        spawned = multiprocessing.get_context("spawn")
        self._pipe, theirs = spawned.Pipe()
        self.process = spawned.Process(target=serve, args=(self.port, theirs), daemon=True)
        self.process.start()
        theirs.close()
        assert self._pipe.poll(TIMEOUT_S) and self._pipe.recv() == "started"

    def stop(self) -> None:
        self.process.kill()
        self.process.join()
        self._pipe.close()

    def write(self, name: str, value: object) -> None:
        self._pipe.send((name, value))
        self._pipe.recv()

    def read(self, name: str) -> Any:
        self._pipe.send((name, None))
        assert self._pipe.poll(TIMEOUT_S)
        return self._pipe.recv()


@pytest.fixture
def machine() -> Machine:
    return parse_machine(MACHINE, "test")


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Control]:
    running = Control(tmp_path_factory.mktemp("server"))
    yield running
    running.stop()


@pytest.fixture
def control(server: Control) -> Control:
    """The one server, which takes seconds to start, with the usual node file."""
    server.nodes.write_text(NODES)
    return server


def delivered(sink: OpcUaSink, correction: Correction = CORRECTION) -> bool:
    try:
        sink.write(correction)
    except WorkError as error:
        assert "opc.tcp://127.0.0.1" in str(error)
        return False
    return True


@pytest.mark.integration
def test_all_nodes_are_read_together(control: Control, machine: Machine, capsys: pytest.CaptureFixture[str]) -> None:
    source = open_source(control.address, machine)
    sample = taken(source)
    assert (sample.values, sample.readings_um) == ({"front": 20.0, "room": 19.0}, {})  # the probe's value may be old
    assert abs(sample.time_s - time.time()) < TIMEOUT_S
    control.write("Probe", 3.5)
    control.write("Front", "bad")
    sample = taken(source, lambda s: "front" not in s.values or s.readings_um)
    readings = [sample.readings_um] if sample.readings_um else []
    taken(source, lambda s: readings.append(s.readings_um) if s.readings_um else "front" not in s.values)
    assert readings == [{"z": 3.5}]  # counts once
    control.write("Front", 21.0)
    taken(source, lambda s: s.values.get("front") == 21.0)
    source.close()
    source.close()
    assert list(source.samples()) == []
    (report,) = capsys.readouterr().err.splitlines()
    assert "s=Front of 'front': got None (BadSensorFailure), expected a number" in report


@pytest.mark.integration
def test_a_correction_is_written_with_the_types_of_its_nodes(control: Control, machine: Machine) -> None:
    sink = open_sink(control.address, machine)
    for beat in (0, 1, 255, 256, 257):
        sink.write(replace(CORRECTION, heartbeat=beat, valid_until_s=1.7e9 + beat))
        assert (control.read("Beat"), control.read("Until")) == (beat % 256, 1.7e9 + beat)
    assert (control.read("Offset"), control.read("OffsetX"), control.read("Slope")) == (-12.25, 0.5, 3.5)
    assert (control.read("StateZ"), control.read("State")) == ("active", "active")
    assert control.read("ReasonZ") == "provisional model"
    sink.close()
    sink.close()
    assert (control.read("StateZ"), control.read("State")) == ("off", "off")
    with pytest.raises(WorkError, match="closed"):
        sink.write(CORRECTION)


@pytest.mark.integration
@pytest.mark.parametrize(
    ("node", "message"),
    [
        ("ReadOnly", "node ns=2;s=ReadOnly of offset z refuses -12.25 .*make it writable"),
        ("Beat", "got the type Byte, expected Double or Float"),
        ("Nowhere", "node ns=2;s=Nowhere of offset z: .*BadNodeIdUnknown"),
    ],
)
def test_a_node_that_takes_no_offset_is_named(control: Control, machine: Machine, node: str, message: str) -> None:
    control.nodes.write_text(f"offsets_um: {{z: ns=2;s={node}}}")
    sink = open_sink(control.address, machine)
    with pytest.raises(WorkError, match=message):
        sink.write(CORRECTION)
    sink.close()


@pytest.mark.integration
@pytest.mark.slow
def test_source_and_sink_recover_from_a_restart_of_the_server(
    control: Control, machine: Machine, capsys: pytest.CaptureFixture[str]
) -> None:
    source, sink = open_source(control.address, machine), open_sink(control.address, machine)
    taken(source)
    sink.write(CORRECTION)
    control.stop()
    eventually(lambda: not delivered(sink), "the loss is not noticed")
    while next(source.samples()) is not None:
        pass
    control.start()
    control.write("Front", 33.0)
    taken(source, lambda s: s.values.get("front") == 33.0)
    eventually(lambda: delivered(sink), "the sink does not recover")
    assert control.read("Offset") == -12.25
    source.close()
    sink.close()
    err = capsys.readouterr().err
    assert err.count("trying again until it works") == err.count("connected again") == 2
    assert "Traceback" not in err


@pytest.mark.integration
def test_a_frozen_server_holds_a_write_up_for_a_bounded_time(control: Control, machine: Machine) -> None:
    sink = open_sink(control.address, machine)
    sink.write(CORRECTION)
    assert control.process.pid is not None
    os.kill(control.process.pid, signal.SIGSTOP)
    try:
        with pytest.raises(WorkError, match="does not answer in"):
            sink.write(CORRECTION)
    finally:
        os.kill(control.process.pid, signal.SIGCONT)
    eventually(lambda: delivered(sink), "the sink does not recover")
    sink.close()


@pytest.mark.parametrize(
    ("nodes", "message"),
    [
        ("values: {frnt: ns=2;s=A}", "values: unknown channel 'frnt': did you mean 'front'?"),
        ("values: {front: Head.Front}", "'Head.Front' is no node id; write it like"),
        ("value: {front: ns=2;s=A}", "unknown key 'value'; did you mean 'values'?"),
        ("offsets_um: {z: ns=2;s=A}", "has no values"),
        ("{values: {front: ns=2;s=A}, interval_s: 0}", "interval_s"),
    ],
)
def test_a_wrong_node_file_is_one_clear_line(machine: Machine, tmp_path: Path, nodes: str, message: str) -> None:
    path = tmp_path / "nodes.yml"
    path.write_text(nodes)
    with pytest.raises(InputError) as caught:
        open_source(f"opc.tcp://127.0.0.1:4840/plc?nodes={path}", machine)
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_a_missing_package_names_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "asyncua", None)
    monkeypatch.delitem(sys.modules, "compensation.connectors.opcua")
    machine = parse_machine(MACHINE, "m.yml")
    with pytest.raises(InputError, match=r"opc\.tcp: package asyncua is not .*run pip install 'thermodrift\[opcua\]'"):
        open_source("opc.tcp://127.0.0.1:1?nodes=nodes.yml", machine)
