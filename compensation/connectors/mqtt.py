"""MQTT: samples from topics of a broker, corrections to topics of a broker."""

from __future__ import annotations

import json
import socket
import ssl
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any
from urllib.parse import urlsplit

from paho.mqtt.client import Client, ConnectFlags, DisconnectFlags, MQTTMessage
from paho.mqtt.enums import CallbackAPIVersion
from paho.mqtt.properties import Properties
from paho.mqtt.reasoncodes import ReasonCode

from compensation.connectors.messages import (
    IDLE_S,
    Inbox,
    Names,
    NetworkAddress,
    Reports,
    check_deliverable,
    correction_record,
    credentials,
    deadline_s,
    overall_state,
    sample_from_json,
    take,
    warn,
)
from compensation.contracts import Correction, Sample
from data.errors import InputError, WorkError
from data.machine import Machine

SECRETS = "THERMODRIFT_MQTT"
KEEPALIVE_S = 5  # the broker sends the last will after 1.5 times this without a sign of life
COLLECT_S = 1.0
_POLL_S = 0.1  # between two looks at the end of an interval
_FIRST_CONNECTION_S = 3.0  # that a new sink waits for its broker, before the first write
_PORTS = {"mqtt": 1883, "mqtts": 8883}
_MAX_PAYLOAD_BYTES = 1_000_000
_REPORTED = 3  # of an unbroken row of unreadable payloads of one topic


def prompt_socket(client: Client, userdata: Any, opened: Any) -> None:
    """Small messages leave at once instead of waiting for the receipt of the one before, which takes 40 ms."""
    with suppress(OSError):  # a socket of another kind
        opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


class _Link:
    """A client with its thread that connects, and reconnects with a delay that grows from 1 s to 5 s."""

    def __init__(self, address: str, query: tuple[str, ...], on_connected: Callable[[], object] | None = None) -> None:
        """`query`: known query keys; `on_connected`: what to do at every new connection, in the client's thread."""
        port = _PORTS[urlsplit(address).scheme]
        self.address = NetworkAddress.parse(address, port, (*query, "ca"), SECRETS)
        self.where = self.address.text
        self.prefix = self.address.path
        if not self.prefix or any(c in self.prefix for c in "+#\0"):
            raise InputError(
                f"{self.where}: got the topic prefix {self.prefix!r}, expected one without '+' and '#', such as "
                f"{self.address.scheme}://{self.address.host}/machine7"
            )
        self.connected = threading.Event()
        self._on_connected = on_connected
        self.problem = "not connected yet"
        self.refused = ""  # by the broker, before any connection: nothing will change by itself
        self.client = Client(CallbackAPIVersion.VERSION2, reconnect_on_failure=True)
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
        self.client.on_socket_open = prompt_socket
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
            why = f"refused by the broker ({reason}); check {SECRETS}_USER and {SECRETS}_PASSWORD"
            self.refused = why if self.problem == "not connected yet" else self.refused
            self._lost(why)
            return
        self.refused = ""
        client.drop_out_messages()  # corrections of before the loss are out of date
        if self.problem and self.problem != "not connected yet":
            warn(f"{self.where}: connected again")
        self.problem = ""
        if self._on_connected is not None:
            self._on_connected()
        self.connected.set()

    def _on_connect_fail(self, client: Client, userdata: Any) -> None:
        # paho calls this while it handles the error, and does not hand it over
        self._lost(f"cannot be reached ({sys.exc_info()[1]})")

    def _on_disconnect(
        self, client: Client, userdata: Any, flags: DisconnectFlags, reason: ReasonCode, properties: Properties | None
    ) -> None:
        if reason.is_failure and self.connected.is_set():  # else the broker refused it, and the reason is known
            self._lost(f"connection lost ({reason})")
        self.connected.clear()

    def _lost(self, why: str) -> None:
        if self.problem in ("", "not connected yet"):  # the later ones are tries to connect again
            warn(f"{self.where}: {why}; trying again until it works")
        self.problem = why
        self.connected.clear()

    def close(self) -> None:
        self.client.disconnect()
        self.client.loop_stop()


class MqttSource:
    """Samples from a broker: ``mqtt://HOST:PORT/PREFIX?interval_s=1``, or ``mqtts://`` with TLS.

    | topic | payload |
    |---|---|
    | `PREFIX/sample` | one JSON object with all channels, see `messages.sample_from_json`; without a time: at arrival |
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
        self._link = _Link(address, ("interval_s",), self._subscribe)
        self._interval_s = self._link.address.seconds("interval_s", COLLECT_S)
        self._names = Names(machine)
        self._errors = machine.names("error")
        self._inbox = Inbox(self._link.where)
        self._payloads = Reports(_REPORTED)
        self._cells = Reports(_REPORTED)
        self._lock = threading.Lock()
        self._values: dict[str, float] = {}
        self._readings: dict[str, float] = {}
        self._due_s: float | None = None  # on the monotonic clock
        self._topics = [f"{self._link.prefix}/{end}" for end in ("sample", "channel/#", "reading/#")]
        self._link.client.on_message = self._on_message
        self._link.start()

    def _subscribe(self) -> None:
        self._link.client.subscribe([(topic, 1) for topic in self._topics])

    def _on_message(self, client: Client, userdata: Any, message: MQTTMessage) -> None:
        topic = message.topic
        where = f"{self._link.where}: topic {topic}"
        kind, _, name = topic.removeprefix(f"{self._link.prefix}/").partition("/")
        try:
            if len(message.payload) > _MAX_PAYLOAD_BYTES:
                raise ValueError(f"got {len(message.payload)} bytes, expected {_MAX_PAYLOAD_BYTES} at most")
            if kind == "sample":
                self._whole(message, where)
            elif not message.retain:
                self._single(kind, name, message.payload.decode("utf-8"), where)
        except ValueError as error:  # also what is no UTF-8
            self._payloads.skipped(topic, f"{where}: {error}")
        else:
            self._payloads.read(topic)

    def _whole(self, message: MQTTMessage, where: str) -> None:
        arrival_s = None if message.retain else time.time()
        sample = sample_from_json(message.payload, self._names, self._cells, where, arrival_s)
        with self._lock:
            readings, self._readings = {**self._readings, **sample.readings_um}, {}
        self._inbox.put(Sample(sample.time_s, sample.values, readings))

    def _single(self, kind: str, name: str, text: str, where: str) -> None:
        target = self._names.of_key(name)
        if kind == "reading" and (target is None or not target.is_reading):
            raise ValueError(f"got a reading of {name!r}, expected an error channel: {', '.join(self._errors)}")
        values: dict[str, float] = {}
        readings: dict[str, float] = {}
        take(target, name, text, self._names, self._cells, where, values, readings)
        if values or readings:
            with self._lock:
                self._values |= values
                self._readings |= readings
                if self._due_s is None:
                    self._due_s = time.monotonic() + self._interval_s

    def _collected(self) -> Sample | None:
        """The sample of an interval that has ended."""
        with self._lock:
            if self._due_s is None or time.monotonic() < self._due_s:
                return None
            values, readings = self._values, self._readings
            self._values, self._readings, self._due_s = {}, {}, None
        return Sample(time.time(), values, readings) if values or readings else None

    def samples(self) -> Iterator[Sample | None]:
        """Samples as they arrive, None in silence; ends after `close`.

        Raises:
            InputError: the broker refuses the first connection.
        """
        quiet_from_s = time.monotonic()
        while not self._inbox.closed:
            if self._link.refused:
                raise InputError(f"{self._link.where}: {self._link.refused}")
            for sample in (self._inbox.get(_POLL_S), self._collected()):
                if sample is not None and not self._inbox.closed:
                    yield sample
                    quiet_from_s = time.monotonic()
            if time.monotonic() - quiet_from_s >= IDLE_S and not self._inbox.closed:
                yield None
                quiet_from_s = time.monotonic()

    def close(self) -> None:
        """Disconnect; `samples` then ends."""
        self._inbox.close()
        self._link.close()


class MqttSink:
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
    order to send 0, but says that nobody sends. The sink connects again by itself. It never queues: what cannot be
    delivered at once is dropped, since a late correction is a wrong one.

    Raises:
        InputError: an unusable address or certificate.
    """

    def __init__(self, address: str, machine: Machine) -> None:
        self._link = _Link(address, ())
        self._state_topic = f"{self._link.prefix}/state"
        self._closed = False
        self._link.client.will_set(self._state_topic, "off", qos=1, retain=True)
        self._link.start()
        self._link.connected.wait(_FIRST_CONNECTION_S)

    def write(self, correction: Correction) -> None:
        """Publish one correction, and wait for the broker's receipt for less than a second.

        Raises:
            WorkError: not connected, no receipt in time, or a number is not finite.
        """
        link, until_s = self._link, deadline_s()
        check_deliverable(correction, link.where)
        if self._closed or not link.connected.is_set():
            raise WorkError(f"{link.where}: {link.problem or 'closed'}; the correction is dropped; check the broker")
        root = f"{link.prefix}/correction"
        record = correction_record(correction)
        messages = [
            (f"{root}/{_level(axis)}/{key}", str(value), False)
            for key in ("offset_um", "slope_um_per_m", "state")
            for axis, value in record[key].items()
        ]
        messages.append((f"{link.prefix}/heartbeat", str(correction.heartbeat), False))
        messages.append((root, json.dumps(record, ensure_ascii=False), True))
        messages.append((self._state_topic, overall_state(correction), True))
        try:
            sent = [link.client.publish(topic, text, qos=1, retain=retain) for topic, text, retain in messages]
            for info in sent:
                info.wait_for_publish(max(0.001, until_s - time.monotonic()))
            delivered = all(info.is_published() for info in sent)
        except (RuntimeError, ValueError) as error:
            self._forget()
            raise WorkError(f"{link.where}: not delivered ({error}); check the broker") from None
        if not delivered:
            self._forget()
            raise WorkError(f"{link.where}: the broker does not confirm a correction in time; check the broker")

    def _forget(self) -> None:
        """Drop what waits for a receipt: it must not arrive later, after a newer one or after a fade-out."""
        self._link.client.drop_out_messages()

    def close(self) -> None:
        """Publish `off` and disconnect."""
        if self._closed:
            return
        self._closed = True
        if self._link.connected.is_set():
            try:
                self._link.client.publish(self._state_topic, "off", qos=1, retain=True).wait_for_publish(1.0)
            except (RuntimeError, ValueError) as error:
                warn(f"{self._link.where}: the state 'off' is not delivered ({error}); check the control")
        self._forget()
        self._link.close()


def _level(axis: str) -> str:
    """An axis as one level of a topic."""
    return axis.translate(str.maketrans("/+#", "___"))
