"""OPC UA: samples from nodes of a server, corrections to nodes of a server."""

from __future__ import annotations

import asyncio
import concurrent.futures
import logging
import threading
import time
from collections.abc import Awaitable, Callable, Collection, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, ClassVar

from pydantic import BaseModel, ConfigDict, Field, field_validator

from compensation.connectors.messages import BLOCK_S, Reports, excerpt, number, overall_state
from compensation.connectors.network import Delivery, Feed, Link, NetworkAddress, credentials
from compensation.contracts import Correction, Sample
from data.errors import InputError, WorkError, closest
from data.machine import Machine
from data.yaml_file import load_yaml

try:
    from asyncua import Client, ua
except ModuleNotFoundError as missing:
    raise InputError(
        f"opc.tcp: package {missing.name} is not installed; run pip install 'thermodrift[opcua]'"
    ) from None

SECRETS = "THERMODRIFT_OPCUA"
_PORT = 4840
_REQUEST_S = 4.0  # that a server may take to answer
_CONNECT_S = 10.0
_FIRST_CONNECTION_S = 5.0  # that a new sink waits for its server, before the first write
_LONGEST_DELAY_S = 5.0  # between two tries to connect
_INTEGER_BITS = {"SByte": 7, "Byte": 8, "Int16": 15, "UInt16": 16, "Int32": 31, "UInt32": 32, "Int64": 63, "UInt64": 64}
_NUMBER = ("Double", "Float")
_OF_AXES = ("readings", "offsets_um", "slopes_um_per_m", "states", "reasons")  # sections of `Nodes`
_TYPES = {  # of the nodes that are written, by the first word of their key; others are of type String
    "offset": _NUMBER, "slope": _NUMBER, "valid_until_s": ("Double",), "heartbeat": tuple(_INTEGER_BITS)
}  # fmt: skip

# asyncua logs every lost connection with a traceback, which is reported here in one line
logging.getLogger("asyncua").setLevel(logging.CRITICAL)


class Nodes(BaseModel):
    """The mapping file: which node of the server is what; see `OpcUaSource` and `OpcUaSink`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    interval_s: Annotated[float, Field(gt=0)] = 1.0
    values: dict[str, str] = {}  # channel -> node
    readings: dict[str, str] = {}  # error channel -> node
    offsets_um: dict[str, str] = {}  # axis -> node
    slopes_um_per_m: dict[str, str] = {}
    states: dict[str, str] = {}
    reasons: dict[str, str] = {}
    state: str | None = None
    heartbeat: str | None = None
    valid_until_s: str | None = None

    @field_validator("values", *_OF_AXES, "state", "heartbeat", "valid_until_s")
    @classmethod
    def _node_ids(cls, given: Any) -> Any:
        for node_id in given.values() if isinstance(given, dict) else [given] if given is not None else []:
            try:
                _parsed(node_id, 0)
            except (ua.UaError, ValueError):
                raise ValueError(f"{node_id!r} is no node id; write it like 'ns=2;s=Head.Front'") from None
        return given


def _parsed(node_id: str, namespace: int) -> ua.NodeId:
    """A node id; `namespace` takes the place of one that is given as ``nsu=URI;``."""
    if node_id.startswith("nsu="):
        node_id = f"ns={namespace};{node_id.partition(';')[2]}"
    return ua.NodeId.from_string(node_id)


def _load_nodes(path: str, machine: Machine, where: str) -> Nodes:
    nodes = load_yaml(Path(path), Nodes, "node file")
    errors = machine.names("error")
    inputs = [name for name in machine.channels if name not in errors]
    known: Mapping[str, Collection[str]] = {"values": inputs, **dict.fromkeys(_OF_AXES, errors)}
    for section, names in known.items():
        for name in getattr(nodes, section):
            if name not in names:
                raise InputError(f"node file {path}: {section}: unknown channel {name!r}: {closest(name, names)}")
    return nodes


class _Link(Link):
    """A session with a server in a thread with its own event loop; begins again by itself after every loss."""

    def __init__(self, address: str, machine: Machine, session: Callable[[Client], Awaitable[None]]) -> None:
        """`session` runs as long as a connection lasts; it says when it is `up`, and raises when it is lost."""
        parsed = NetworkAddress.parse(address, _PORT, ("nodes",), SECRETS)
        super().__init__(parsed)
        if "nodes" not in parsed.query:
            raise InputError(f"{self.where}: no node file; write {self.where}?nodes=FILE.yml")
        self.nodes = _load_nodes(parsed.query["nodes"], machine, self.where)
        host = f"[{parsed.host}]" if ":" in parsed.host else parsed.host
        self._url = f"opc.tcp://{host}:{parsed.port}/{parsed.path}".rstrip("/")
        self._user = credentials(SECRETS)
        self._session = session
        self._loop: asyncio.AbstractEventLoop | None = None
        self._closing: asyncio.Event | None = None
        self._started = threading.Event()
        self._thread = threading.Thread(target=self._run, name=self.where, daemon=True)

    def start(self) -> None:
        self._thread.start()
        self._started.wait()

    def _run(self) -> None:
        asyncio.run(self._keep())

    async def _keep(self) -> None:
        self._loop, self._closing = asyncio.get_running_loop(), asyncio.Event()
        self._started.set()
        delay_s = 1.0
        while not self._closing.is_set():
            client = Client(self._url, timeout=_REQUEST_S, watchdog_intervall=2.0)
            if self._user is not None:
                client.set_user(self._user[0])
                client.set_password(self._user[1] or "")
            try:
                await self._until_closing(self._connected(client))
            except Exception as error:  # whatever a broken server causes must not end the thread
                delay_s = delay_s if self.problem else 1.0
                self.lost(" ".join((str(error) or type(error).__name__).split()))
            with suppress(Exception):
                await asyncio.wait_for(client.disconnect(), 2.0)
            client.disconnect_socket()
            await self._until_closing(asyncio.sleep(delay_s))
            delay_s = min(2 * delay_s, _LONGEST_DELAY_S)

    async def _connected(self, client: Client) -> None:
        await asyncio.wait_for(client.connect(), _CONNECT_S)
        await self._session(client)

    async def _until_closing(self, work: Awaitable[None]) -> None:
        """Wait for `work`; stop it when the link closes."""
        assert self._closing is not None
        task, closing = asyncio.ensure_future(work), asyncio.ensure_future(self._closing.wait())
        await asyncio.wait({task, closing}, return_when=asyncio.FIRST_COMPLETED)
        closing.cancel()
        if not task.done():
            task.cancel()
            with suppress(asyncio.CancelledError, Exception):
                await task
        else:
            task.result()

    async def node_ids(self, client: Client, given: Mapping[str, str]) -> dict[str, ua.NodeId]:
        """Node ids under the same keys; namespaces that are given by their URI have the server's present index."""
        uris = {text[4:].partition(";")[0] for text in given.values() if text.startswith("nsu=")}
        index = {uri: await client.get_namespace_index(uri) for uri in uris}
        return {key: _parsed(text, index.get(text[4:].partition(";")[0], 0)) for key, text in given.items()}

    def call(self, work: Callable[[], Any], timeout_s: float) -> Any:
        """Run a coroutine in the link's thread and wait for its result; TimeoutError after `timeout_s`."""
        assert self._loop is not None
        future = asyncio.run_coroutine_threadsafe(work(), self._loop)
        try:
            return future.result(timeout_s)
        finally:
            future.cancel()

    def disconnect(self) -> None:
        if self._loop is not None and self._closing is not None:
            with suppress(RuntimeError):  # the loop has ended
                self._loop.call_soon_threadsafe(self._closing.set)
            self._thread.join(5.0)


class OpcUaSource(Feed[_Link]):
    """Samples from a server: ``opc.tcp://HOST:PORT/PATH?nodes=FILE.yml``.

    The node file::

        interval_s: 1              # between two samples, s
        values:                    # channel: node, in the channel's unit of the machine file
          front: ns=2;s=Head.Front
          spindle_rpm: nsu=http://maker.example/plc;s=Spindle.Speed
        readings:                  # error channel: node of the last measured error, in its unit (µm)
          z: ns=2;i=17

    The source reads all nodes together, every `interval_s`; the time of a sample is this computer's, as clocks of
    controls are often wrong. A node whose status is bad, or that holds no number, is left out and reported. A reading
    counts once, when its node's value changes; what it holds at the connection is of unknown age and does not count.
    User and password come from THERMODRIFT_OPCUA_USER and THERMODRIFT_OPCUA_PASSWORD. The source connects again by
    itself.

    Raises:
        InputError: an unusable address, no node file, an unknown channel or a wrong node id in it, no values in it.
    """

    def __init__(self, address: str, machine: Machine) -> None:
        super().__init__(_Link(address, machine, self._read_on))
        if not self.link.nodes.values:
            raise InputError(f"{self.link.where}: the node file has no values; add values: with channel: node id")
        self._cells = Reports()
        self.link.start()

    async def _read_on(self, client: Client) -> None:
        nodes = self.link.nodes
        value_ids = await self.link.node_ids(client, nodes.values)
        reading_ids = await self.link.node_ids(client, nodes.readings)
        wanted = [*value_ids.values(), *reading_ids.values()]
        last: dict[str, float] | None = None
        due_s = time.monotonic()
        while True:
            cells = await client.uaclient.read_attributes(wanted, ua.AttributeIds.Value)
            time_s = time.time()
            values = self._numbers(value_ids, cells[: len(value_ids)])
            measured = self._numbers(reading_ids, cells[len(value_ids) :])
            readings = {a: v for a, v in measured.items() if last is not None and last.get(a) != v}
            last = {**(last or {}), **measured}
            self.link.up()
            self.inbox.put(Sample(time_s, values, readings))
            due_s = max(due_s + nodes.interval_s, time.monotonic())
            await asyncio.sleep(due_s - time.monotonic())

    def _numbers(self, node_ids: Mapping[str, ua.NodeId], cells: list[ua.DataValue]) -> dict[str, float]:
        out = {}
        for (name, node_id), cell in zip(node_ids.items(), cells, strict=True):
            held = cell.Value.Value if cell.Value is not None else None
            value = number(held)
            if value is None or (cell.StatusCode is not None and not cell.StatusCode.is_good()):
                status = cell.StatusCode.name if cell.StatusCode is not None else "no status"
                where = f"{self.link.where}: node {node_id.to_string()} of {name!r}"
                self._cells.skipped(name, f"{where}: got {excerpt(held)} ({status}), expected a number")
            else:
                self._cells.read(name)
                out[name] = value
        return out


class OpcUaSink(Delivery[_Link]):
    """Corrections to a server: ``opc.tcp://HOST:PORT/PATH?nodes=FILE.yml``.

    The node file, next to what `OpcUaSource` reads from it::

        offsets_um:                # axis: node (Double or Float), written, µm
          z: ns=2;s=Comp.Z.Offset
        slopes_um_per_m:           # axis: node (Double or Float), written, µm/m
          z: ns=2;s=Comp.Z.Slope
        states:                    # axis: node (String), `off`, `warm-up`, `active`, `hold` or `fade-out`
          z: ns=2;s=Comp.Z.State
        reasons:                   # axis: node (String), why it is not active or acts in part; what its model is
          z: ns=2;s=Comp.Z.Reason
        state: ns=2;s=Comp.State   # String, the state with most authority among the axes
        heartbeat: ns=2;s=Comp.Beat  # any integer: counts the corrections, from 0 again after the largest
        valid_until_s: ns=2;s=Comp.Until  # Double: Unix time after which the control holds what it has

    The sink writes all of them in one request, the heartbeat last; `close` writes the states `off`. OPC UA has no last
    will: a control takes the correction back when the heartbeat stands still. The sink connects again by itself, and
    never queues.

    Raises:
        InputError: an unusable address, no node file, an unknown axis or a wrong node id in it, no offsets in it.
    """

    peer: ClassVar[str] = "server"

    def __init__(self, address: str, machine: Machine) -> None:
        super().__init__(_Link(address, machine, self._hold))
        nodes = self.link.nodes
        if not nodes.offsets_um:
            raise InputError(f"{self.link.where}: the node file has no offsets_um; add offsets_um: with axis: node id")
        self._wanted: dict[str, str] = {
            **{f"offset {axis}": node for axis, node in nodes.offsets_um.items()},
            **{f"slope {axis}": node for axis, node in nodes.slopes_um_per_m.items()},
            **{f"state {axis}": node for axis, node in nodes.states.items()},
            **{f"reason {axis}": node for axis, node in nodes.reasons.items()},
            **{key: node for key in ("state", "valid_until_s", "heartbeat") if (node := getattr(nodes, key))},
        }
        self._client: Client | None = None
        self._node_ids: dict[str, ua.NodeId] = {}
        self._types: dict[str, ua.VariantType] = {}
        self._axes = Reports()
        self.link.start()
        self.link.settled.wait(_FIRST_CONNECTION_S)

    async def _hold(self, client: Client) -> None:
        """Find out the nodes' types, then wait until the connection is lost."""
        lost: asyncio.Future[None] = asyncio.get_running_loop().create_future()

        async def on_lost(error: Exception) -> None:
            if not lost.done():
                lost.set_exception(ConnectionError(f"connection lost ({error or type(error).__name__})"))

        client.connection_lost_callback = on_lost
        self._node_ids = await self.link.node_ids(client, self._wanted)
        for key, node_id in self._node_ids.items():
            try:
                kind = await client.get_node(node_id).read_data_type_as_variant_type()
            except ua.UaStatusCodeError as error:
                raise ConnectionError(f"node {node_id.to_string()} of {key}: {error}; correct the node file") from None
            expected = _TYPES.get(key.partition(" ")[0], ("String",))
            if kind.name not in expected:
                raise ConnectionError(
                    f"node {node_id.to_string()} of {key}: got the type {kind.name}, expected {' or '.join(expected)}; "
                    "correct the node file or the control's program"
                )
            self._types[key] = kind
        self._client = client
        self.link.up()
        await lost

    def send(self, correction: Correction) -> None:
        where = self.link.where
        for axis, offset_um in correction.offset_um.items():
            if offset_um and axis not in self.link.nodes.offsets_um:
                self._axes.skipped(axis, f"{where}: axis {axis!r} has a correction and no node under offsets_um")
        given: dict[str, Any] = {
            **{f"offset {axis}": float(v) for axis, v in correction.offset_um.items()},
            **{f"slope {axis}": float(v) for axis, v in correction.slope_um_per_m.items()},
            **{f"state {axis}": v for axis, v in correction.state.items()},
            **{f"reason {axis}": v for axis, v in correction.reasons.items()},
            "state": overall_state(correction),
            "valid_until_s": correction.valid_until_s,
        }
        if "heartbeat" in self._wanted:
            given["heartbeat"] = correction.heartbeat % 2 ** _INTEGER_BITS[self._types["heartbeat"].name]
        self._write(given)

    def send_off(self) -> None:
        self._write({key: "off" for key in self._wanted if key.startswith("state")})

    def _write(self, given: Mapping[str, Any]) -> None:
        """Write values under the keys of `_wanted`; others are left out.

        Raises:
            WorkError: see `write`.
        """
        client, where = self._client, self.link.where
        keys = [key for key in self._wanted if key in given]
        if client is None or not keys:
            return
        ids = [self._node_ids[key] for key in keys]
        # without a time stamp: many controls refuse values that have one
        cells = [ua.DataValue(ua.Variant(given[key], self._types[key])) for key in keys]
        try:
            codes = self.link.call(lambda: client.uaclient.write_attributes(ids, cells, ua.AttributeIds.Value), BLOCK_S)
        except (TimeoutError, concurrent.futures.CancelledError):
            raise WorkError(f"{where}: the server does not answer in {BLOCK_S} s; check the server") from None
        except (OSError, RuntimeError, ua.UaError) as error:
            raise WorkError(f"{where}: not delivered ({error or type(error).__name__}); check the server") from None
        for key, node_id, code in zip(keys, ids, codes, strict=True):
            if not code.is_good():
                raise WorkError(
                    f"{where}: node {node_id.to_string()} of {key} refuses {given[key]!r} ({code.name}); "
                    "make it writable or correct the node file"
                )
