"""MQTT: samples from topics of a broker, corrections to topics of a broker; and the machine's side of both."""

from __future__ import annotations

import json
import socket
import ssl
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict
from queue import Empty, SimpleQueue
from typing import Any, ClassVar
from urllib.parse import urlsplit

from paho.mqtt.client import Client, ConnectFlags, DisconnectFlags, MQTTMessage
from paho.mqtt.enums import CallbackAPIVersion
from paho.mqtt.properties import Properties
from paho.mqtt.reasoncodes import ReasonCode

from compensation.connectors.messages import BLOCK_S, Decoder, Reports, overall_state
from compensation.connectors.network import Delivery, Feed, Link, NetworkAddress, credentials
from compensation.contracts import Correction, Sample
from data.errors import InputError, WorkError
from data.machine import Machine

SECRETS = "THERMODRIFT_MQTT"
KEEPALIVE_S = 5  # the broker sends the last will after 1.5 times this without a sign of life
COLLECT_S = 1.0
_FIRST_CONNECTION_S = 3.0  # that a new sink waits for its broker, before the first write
_PORTS = {"mqtt": 1883, "mqtts": 8883}
_MAX_PAYLOAD_BYTES = 1_000_000
_ANSWER_S, _AGAIN_S = 30.0, 1.0  # that an exchange waits, and between two tries
_ONE_LEVEL = str.maketrans("/+#", "___")  # of a topic
_REPORTED = 3  # of an unbroken row of unreadable payloads of one topic


def prompt_client() -> Client:
    """A client that does not wait for TCP: the default takes 40 ms where one small message follows another."""
    client = Client(CallbackAPIVersion.VERSION2, reconnect_on_failure=True)
    client.on_socket_open = lambda _, __, opened: _set_tcp(opened, "TCP_NODELAY")
    # the broker may keep its next message back until TCP has acknowledged a receipt; Linux forgets this in each packet
    client.on_publish = lambda *_: _set_tcp(client.socket(), "TCP_QUICKACK")
    return client


def _set_tcp(opened: Any, option: str) -> None:
    with suppress(OSError, AttributeError):  # a socket of another kind, or none; a system without the option
        opened.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), 1)


class _Link(Link):
    """A client with its thread that connects, and reconnects with a delay that grows from 1 s to 5 s."""

    def __init__(self, address: str, query: tuple[str, ...], on_connected: Callable[[], object] = lambda: None) -> None:
        """`query`: known query keys; `on_connected`: what to do at every new connection, in the client's thread."""
        port = _PORTS[urlsplit(address).scheme]
        super().__init__(NetworkAddress.parse(address, port, (*query, "ca"), SECRETS))
        self.prefix = self.address.path
        if not self.prefix or any(c in self.prefix for c in "+#\0"):
            raise InputError(
                f"{self.where}: got the topic prefix {self.prefix!r}, expected one without '+' and '#', such as "
                f"{self.address.scheme}://{self.address.host}/machine7"
            )
        self._on_connected = on_connected
        self.client = prompt_client()
        self.client.reconnect_delay_set(1, 5)
        # no limit of its own: paho counts messages that `drop_out_messages` dropped as in flight for ever
        self.client.max_inflight_messages_set(0)
        self.client.max_queued_messages_set(1000)
        user = credentials(SECRETS)
        if user is not None:
            self.client.username_pw_set(*user)
        if self.address.scheme == "mqtts":
            self._use_tls(self.address.query.get("ca"))
        elif "ca" in self.address.query:
            raise InputError(f"{self.where}: 'ca' names a certificate, which mqtt:// does not use; write mqtts://")
        self.client.on_connect = self._on_connect
        self.client.on_connect_fail = self._on_connect_fail
        self.client.on_disconnect = self._on_disconnect

    def _use_tls(self, ca_file: str | None) -> None:
        try:
            self.client.tls_set(ca_certs=ca_file)
        except (OSError, ssl.SSLError, ValueError) as error:
            raise InputError(
                f"{self.where}: certificate {ca_file}: cannot be read ({error}); give the PEM file of the broker's "
                "certificate authority"
            ) from None

    def start(self) -> None:
        self.client.connect_async(self.address.host, self.address.port, keepalive=KEEPALIVE_S)
        self.client.loop_start()

    def _on_connect(
        self, client: Client, userdata: Any, flags: ConnectFlags, reason: ReasonCode, properties: Properties | None
    ) -> None:
        if reason.is_failure:
            self.lost(f"refused by the broker ({reason}); check {SECRETS}_USER and {SECRETS}_PASSWORD", refused=True)
            return
        client.drop_out_messages()  # corrections of before the loss are out of date
        self._on_connected()
        self.up()

    def _on_connect_fail(self, client: Client, userdata: Any) -> None:
        # paho calls this while it handles the error, and does not hand it over
        self.lost(f"cannot be reached ({sys.exc_info()[1]})")

    def _on_disconnect(
        self, client: Client, userdata: Any, flags: DisconnectFlags, reason: ReasonCode, properties: Properties | None
    ) -> None:
        if reason.is_failure and self.ready.is_set():  # else the broker refused it, and the reason is known
            self.lost(f"connection lost ({reason})")
        self.ready.clear()

    def disconnect(self) -> None:
        self.client.disconnect()
        self.client.loop_stop()


class MqttSource(Feed[_Link]):
    """Samples from a broker: ``mqtt://HOST:PORT/PREFIX?interval_s=1``, or ``mqtts://`` with TLS.

    | topic | payload |
    |---|---|
    | `PREFIX/sample` | one JSON object with all channels, see `messages.Decoder.sample`; without a time: at arrival |
    | `PREFIX/channel/NAME` | a number, in the channel's unit of the machine file |
    | `PREFIX/reading/AXIS` | a number, the measured error in the unit of the machine file (µm) |

    Numbers of single topics are collected for `interval_s` (1 s) from the first one on, and then make one sample at the
    time of the interval's end; the last number of a topic counts. A `PREFIX/sample` takes readings that wait along. A
    retained message without a time is skipped: nobody knows its age.

    `ca` names the PEM file of a certificate authority, for `mqtts://` with a broker that the system does not trust.
    User and password come from THERMODRIFT_MQTT_USER and THERMODRIFT_MQTT_PASSWORD. The source connects again by
    itself; it keeps 1000 samples at most and drops the oldest. A payload that cannot be read is skipped and reported.

    Raises:
        InputError: an unusable address or certificate.
    """

    def __init__(self, address: str, machine: Machine) -> None:
        ends = ("sample", "channel/#", "reading/#")
        link = _Link(
            address, ("interval_s",), lambda: self._client.subscribe([(f"{self._prefix}/{end}", 1) for end in ends])
        )
        super().__init__(link)
        self._interval_s = link.address.seconds("interval_s", COLLECT_S)
        self._errors = machine.names("error")
        self._payloads, self._decoder = Reports(_REPORTED), Decoder(machine, _REPORTED)
        self._prefix, self._client = link.prefix, link.client
        self._client.on_message = self._on_message
        link.start()

    def _on_message(self, client: Client, userdata: Any, message: MQTTMessage) -> None:
        topic = message.topic
        where = f"{self.link.where}: topic {topic}"
        kind, _, name = topic.removeprefix(f"{self._prefix}/").partition("/")
        try:
            if len(message.payload) > _MAX_PAYLOAD_BYTES:
                raise ValueError(f"got {len(message.payload)} bytes, expected {_MAX_PAYLOAD_BYTES} at most")
            if kind == "sample":
                arrival_s = None if message.retain else time.time()
                self.inbox.put(self._decoder.sample(message.payload, where, arrival_s))
            elif not message.retain:
                self._single(kind, name, message.payload.decode("utf-8"), where)
        except ValueError as error:  # also what is no UTF-8
            self._payloads.skipped(topic, f"{where}: {error}")
        else:
            self._payloads.read(topic)

    def _single(self, kind: str, name: str, text: str, where: str) -> None:
        target = self._decoder.target(name)
        if kind == "reading" and (target is None or not target.is_reading):
            raise ValueError(f"got a reading of {name!r}, expected an error channel: {', '.join(self._errors)}")
        values, readings = self._decoder.numbers([(name, target, text)], where)
        if values or readings:
            self.inbox.collect(values, readings, self._interval_s)


class MqttSink(Delivery[_Link]):
    """Corrections to a broker: ``mqtt://HOST:PORT/PREFIX``, or ``mqtts://`` with TLS (`ca`: see `MqttSource`).

    | topic | payload | retained |
    |---|---|---|
    | `PREFIX/correction` | JSON: time_s, and axis → offset_um, slope_um_per_m, state, reasons | yes |
    | `PREFIX/correction/AXIS/offset_um` | a number, µm | no |
    | `PREFIX/correction/AXIS/slope_um_per_m` | a number, µm/m; only axes with a slope | no |
    | `PREFIX/correction/AXIS/state` | `off`, `warm-up`, `active`, `hold` or `fade-out` | no |
    | `PREFIX/heartbeat` | a counter of the corrections: while it stands still, a receiver holds | no |
    | `PREFIX/state` | the state with most authority among the axes; `off` also when the compensator is lost | yes |

    All with QoS 1. Plain numbers are not retained, as they carry no time. The broker itself publishes `off` on
    `PREFIX/state` when it hears nothing from the sink for 7.5 s (last will), and `close` does the same; that is no
    order to send 0, but says that nobody sends. The sink connects again by itself, and never queues.

    Raises:
        InputError: an unusable address or certificate.
    """

    peer: ClassVar[str] = "broker"

    def __init__(self, address: str, machine: Machine) -> None:
        link = _Link(address, ())
        super().__init__(link)
        self._prefix, self._client, self._state_topic = link.prefix, link.client, f"{link.prefix}/state"
        self._client.will_set(self._state_topic, "off", qos=1, retain=True)
        link.start()
        link.settled.wait(_FIRST_CONNECTION_S)

    def send(self, correction: Correction) -> None:
        root, record = f"{self._prefix}/correction", asdict(correction)
        messages = [(root, json.dumps(record, ensure_ascii=False), True)]  # first, as a control acts on it
        messages += [
            (f"{root}/{axis.translate(_ONE_LEVEL)}/{key}", str(value), False)
            for key in ("offset_um", "slope_um_per_m", "state")
            for axis, value in record[key].items()
        ]
        messages.append((f"{self._prefix}/heartbeat", str(correction.heartbeat), False))
        messages.append((self._state_topic, overall_state(correction), True))
        self._publish(messages)

    def send_off(self) -> None:
        self._publish([(self._state_topic, "off", True)])

    def _publish(self, messages: Sequence[tuple[str, str, bool]]) -> None:
        """Topics with text and whether it is retained; what has no receipt in time must not arrive later, after a newer
        one or after a fade-out."""
        until_s, why = time.monotonic() + BLOCK_S, "the broker does not confirm a correction in time"
        try:
            sent = [self._client.publish(topic, text, qos=1, retain=retain) for topic, text, retain in messages]
            for info in sent:
                info.wait_for_publish(max(0.001, until_s - time.monotonic()))
            if all(info.is_published() for info in sent):
                return
        except (RuntimeError, ValueError) as error:
            why = f"not delivered ({error})"
        self._client.drop_out_messages()
        raise WorkError(f"{self.link.where}: {why}; check the broker")


class MqttExchange:
    """The machine's side, for rehearsals: sends `PREFIX/sample` and waits for the `PREFIX/correction` of that time.

    Raises:
        WorkError: the broker does not answer, or nobody compensates there.
    """

    def __init__(self, address: str) -> None:
        parts = urlsplit(address)
        self.address, self.prefix = address, parts.path.strip("/")
        self._answers: SimpleQueue[dict[str, Any]] = SimpleQueue()
        self._ready: SimpleQueue[bool] = SimpleQueue()
        self._heard = False
        self._client = prompt_client()
        self._client.on_connect = lambda client, *_: client.subscribe(f"{self.prefix}/correction", 1)
        self._client.on_subscribe = lambda *_: self._ready.put(True)
        self._client.on_message = lambda _, __, message: self._answers.put(json.loads(message.payload))
        try:
            self._client.connect(parts.hostname or "127.0.0.1", parts.port or 1883)
            self._client.loop_start()
            self._ready.get(timeout=_ANSWER_S)
        except (OSError, Empty) as error:
            raise WorkError(f"broker {address}: does not answer ({error}); start it, or give another address") from None

    def __call__(self, sample: Sample) -> Correction:
        until_s, text, sent_s = time.monotonic() + _ANSWER_S, json.dumps(asdict(sample)), -_AGAIN_S
        while (now_s := time.monotonic()) < until_s:
            if now_s - sent_s >= _AGAIN_S and (sent_s < 0 or not self._heard):  # it may not have subscribed yet
                self._client.publish(f"{self.prefix}/sample", text, 1)
                sent_s = now_s
            try:
                got = self._answers.get(timeout=_AGAIN_S)
            except Empty:
                continue
            if abs(got["time_s"] - sample.time_s) < 1e-3:
                self._heard = True
                return Correction(**got)
        raise WorkError(
            f"{self.address}: no correction within {_ANSWER_S:g} s; start `thermodrift compensate --replay` with the "
            "same address"
        )

    def close(self) -> None:
        """Disconnects."""
        self._client.disconnect()
        self._client.loop_stop()
