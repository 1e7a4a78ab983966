"""Samples from a real MQTT broker and corrections to it; a broker that restarts; the last will."""

from __future__ import annotations

import getpass
import json
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from paho.mqtt.client import Client, MQTTMessage
from paho.mqtt.enums import CallbackAPIVersion

from compensation.connectors import mqtt, open_sink, open_source
from compensation.contracts import Correction, Sample, Source
from data.errors import InputError, WorkError
from data.machine import Machine, parse_machine
from tests.compensation.links import MACHINE, TIMEOUT_S, eventually, taken

BROKER = shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin:/usr/local/sbin")
pytestmark = [
    pytest.mark.integration,
    pytest.mark.skipif(BROKER is None, reason="needs the broker mosquitto: apt-get install mosquitto"),
]

ROOT = Path(__file__).parents[2]
CORRECTION = Correction(100.5, {"z": -12.25}, {"z": 3.5}, {"z": "active"}, {})
LOST_COMPENSATOR = """
import sys, time
from compensation.connectors import open_sink
from compensation.contracts import Correction
from data.machine import parse_machine
sink = open_sink(sys.argv[1], parse_machine(sys.argv[2], "test"))
sink.write(Correction(1.0, {"z": 2.0}, {}, {"z": "active"}))
print("written", flush=True)
time.sleep(600)
"""


class Broker:
    """mosquitto on a free port of this computer; `settings` follow the listener in its configuration."""

    def __init__(self, folder: Path, settings: str) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self._config = folder / "mosquitto.conf"
        # as root it would become another user, who may not read this folder
        self._config.write_text(f"user {getpass.getuser()}\nlistener {self.port} 127.0.0.1\n{settings}")
        self.address = f"mqtt://127.0.0.1:{self.port}/hall/mill"
        self.start()

    def start(self) -> None:
        assert BROKER is not None
        self._process = subprocess.Popen(
            [BROKER, "-c", str(self._config)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        eventually(self._listens, "the broker does not listen")

    def _listens(self) -> bool:
        assert self._process.poll() is None, "the broker has ended"
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", self.port)) == 0

    def stop(self) -> None:
        self._process.kill()
        self._process.wait()


class Control:
    """The other side: publishes, and records what arrives under the prefix."""

    def __init__(self, port: int) -> None:
        self.got: dict[str, str] = {}
        self.order: list[str] = []
        self._subscribed = False
        self._client = Client(CallbackAPIVersion.VERSION2)
        self._client.on_message = self._on_message
        self._client.on_subscribe = self._on_subscribe
        self._client.on_connect = lambda client, *_: client.subscribe("hall/mill/#", 1)
        self._client.connect("127.0.0.1", port)
        self._client.loop_start()
        eventually(lambda: self._subscribed, "the control is not subscribed")

    def _on_message(self, client: Client, userdata: object, message: MQTTMessage) -> None:
        self.order.append(message.topic.removeprefix("hall/mill/"))
        self.got[self.order[-1]] = message.payload.decode(errors="replace")

    def _on_subscribe(self, *_: object) -> None:
        self._subscribed = True

    def publish(self, topic: str, payload: object, retain: bool = False) -> None:
        text = payload if isinstance(payload, str | bytes) else json.dumps(payload)
        self._client.publish(f"hall/mill/{topic}", text, qos=1, retain=retain).wait_for_publish(TIMEOUT_S)

    def close(self) -> None:
        self._client.disconnect()
        self._client.loop_stop()


@pytest.fixture
def machine() -> Machine:
    return parse_machine(MACHINE, "test")


@pytest.fixture
def start_broker(tmp_path: Path) -> Iterator[Callable[[str], Broker]]:
    """Starts brokers with the given settings, which end with the test."""
    running: list[Broker] = []

    def start(settings: str) -> Broker:
        running.append(Broker(tmp_path, settings))
        return running[-1]

    yield start
    for broker in running:
        broker.stop()


@pytest.fixture
def broker(start_broker: Callable[[str], Broker]) -> Broker:
    return start_broker("allow_anonymous true\n")


@pytest.fixture
def control(broker: Broker) -> Iterator[Control]:
    connected = Control(broker.port)
    yield connected
    connected.close()


def opened(address: str, machine: Machine, control: Control) -> Source:
    """A source that receives."""
    source = open_source(address, machine)
    samples = source.samples()
    for _ in range(600):
        control.publish("sample", {"time_s": -1, "front": 0})
        if next(samples) is not None:
            control.publish("sample", {"time_s": -2})  # whatever of these is still under way comes before this one
            while (sample := next(samples)) is None or sample.time_s != -2:
                pass
            return source
    raise AssertionError("the source is not subscribed")


def test_whole_samples(broker: Broker, control: Control, machine: Machine) -> None:
    source = opened(broker.address, machine, control)
    control.publish("sample", {"time_s": 100.5, "values": {"front": 25.5}, "readings_um": {"z": 3.0}})
    assert taken(source) == Sample(100.5, {"front": 25.5}, {"z": 3.0})
    before_s = time.time()
    control.publish("sample", {"front": 26, "z": 4})
    sample = taken(source)
    assert (sample.values, sample.readings_um) == ({"front": 26.0}, {"z": 4.0})
    assert before_s - 1 <= sample.time_s <= time.time() + 1
    assert next(source.samples()) is None
    source.close()
    source.close()
    assert list(source.samples()) == []


def test_single_channels_and_readings_are_collected(broker: Broker, control: Control, machine: Machine) -> None:
    source = opened(f"{broker.address}?interval_s=3", machine, control)
    for topic, payload in (
        ("channel/front", "25"),
        ("channel/room", "20.5"),
        ("channel/front", "26"),
        ("reading/z", 3),
    ):
        control.publish(topic, payload)
    sample = taken(source)
    assert (sample.values, sample.readings_um) == ({"front": 26.0, "room": 20.5}, {"z": 3.0})
    source.close()


def test_a_retained_number_of_unknown_age_does_not_count(broker: Broker, control: Control, machine: Machine) -> None:
    control.publish("reading/z", "99", retain=True)
    control.publish("channel/front", "99", retain=True)
    control.publish("sample", {"time_s": 50, "front": 21}, retain=True)  # has a time of its own
    source = open_source(f"{broker.address}?interval_s=0.2", machine)
    assert taken(source) == Sample(50.0, {"front": 21.0})
    control.publish("channel/room", "20")
    assert taken(source).values == {"room": 20.0}
    source.close()


def test_malformed_payloads_are_skipped_and_reported(
    broker: Broker, control: Control, machine: Machine, capsys: pytest.CaptureFixture[str]
) -> None:
    source = opened(f"{broker.address}?interval_s=0.2", machine, control)
    for payload in (b"\xff\xfe", "[1, 2]", "{", "[" * 100_000, '{"time_s": "noon"}', "9" * 5000, ""):
        control.publish("sample", payload)
    for topic in ("channel/front", "channel/frnt", "reading/front", "reading/z", "channel/"):
        control.publish(topic, "warm")
    control.publish("sample", {"time_s": 7, "front": "warm", "room": 20})
    assert taken(source) == Sample(7.0, {"room": 20.0})
    source.close()
    reports = capsys.readouterr().err.splitlines()
    assert all(line.startswith(f"thermodrift: {broker.address}: topic hall/mill/") for line in reports)
    assert sum("topic hall/mill/sample: got" in line for line in reports) == 3
    text = "\n".join(reports)
    assert "channel/front: front: got 'warm', expected a number" in text
    assert "unknown channel 'frnt': did you mean 'front'?" in text
    assert "got a reading of 'front', expected an error channel: z" in text


def test_a_correction_arrives_as_json_and_as_plain_numbers(broker: Broker, control: Control, machine: Machine) -> None:
    sink = open_sink(broker.address, machine)
    sink.write(CORRECTION)
    eventually(lambda: control.got.get("state") == "active", "no state")
    record = {"time_s": 100.5, "offset_um": {"z": -12.25}, "slope_um_per_m": {"z": 3.5}, "state": {"z": "active"}}
    assert json.loads(control.got["correction"]) == {
        **record, "reasons": {}, "heartbeat": 0, "valid_until_s": 0.0,
    }  # fmt: skip
    assert control.got["heartbeat"] == "0"
    numbers = [f"correction/z/{key}" for key in ("offset_um", "slope_um_per_m", "state")]
    assert control.order == ["correction", *numbers, "heartbeat", "state"]
    assert float(control.got["correction/z/offset_um"]) == -12.25
    assert float(control.got["correction/z/slope_um_per_m"]) == 3.5
    assert control.got["correction/z/state"] == "active"

    late = Control(broker.port)
    eventually(lambda: {"correction", "state"} <= late.got.keys(), "not retained")
    assert late.got.keys() == {"correction", "state"}
    sink.close()
    sink.close()
    eventually(lambda: late.got["state"] == "off", "close does not say off")
    late.close()
    with pytest.raises(WorkError, match="closed"):
        sink.write(CORRECTION)


@pytest.mark.skipif(not hasattr(socket, "TCP_QUICKACK"), reason="needs Linux")
def test_neither_side_waits_for_tcp(broker: Broker, machine: Machine, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    plain = socket.socket.setsockopt

    def noted(self: socket.socket, level: int, option: int, value: int) -> None:
        asked.extend([option] if level == socket.IPPROTO_TCP else [])
        plain(self, level, option, value)

    monkeypatch.setattr(socket.socket, "setsockopt", noted)
    sink = open_sink(broker.address, machine)
    sink.write(CORRECTION)
    eventually(lambda: asked.count(socket.TCP_QUICKACK) == 6, "a receipt is not acknowledged at once")  # 6 topics
    assert asked[0] == socket.TCP_NODELAY
    sink.close()


def test_the_last_will_says_off_when_the_compensator_is_lost(broker: Broker, control: Control) -> None:
    lost = subprocess.Popen(
        [sys.executable, "-c", LOST_COMPENSATOR, broker.address, MACHINE], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
    assert lost.stdout is not None and lost.stdout.readline() == "written\n"
    eventually(lambda: control.got.get("state") == "active", "no state")
    lost.send_signal(signal.SIGKILL)
    lost.wait()
    lost.stdout.close()
    eventually(lambda: control.got["state"] == "off", "no last will")


def test_source_and_sink_recover_from_a_restart_of_the_broker(
    broker: Broker, control: Control, machine: Machine, capsys: pytest.CaptureFixture[str]
) -> None:
    source, sink = opened(broker.address, machine, control), open_sink(broker.address, machine)
    sink.write(CORRECTION)
    broker.stop()

    def delivered(correction: Correction) -> bool:
        try:
            sink.write(correction)
        except WorkError as error:
            assert broker.address in str(error)
            return False
        return True

    eventually(lambda: not delivered(CORRECTION), "the loss is not noticed")
    assert next(source.samples()) is None
    broker.start()
    again = Control(broker.port)
    now = Correction(200.0, {"z": 1.0}, {}, {"z": "hold"})
    eventually(lambda: delivered(now), "the sink does not recover")
    eventually(lambda: again.got.get("state") == "hold", "no state")
    assert json.loads(again.got["correction"])["time_s"] == 200.0  # nothing of before the loss

    until_s = time.monotonic() + TIMEOUT_S
    for sample in source.samples():
        assert time.monotonic() < until_s, "the source does not recover"
        if sample is None:
            again.publish("sample", {"time_s": 300, "front": 30})
        elif sample.time_s == 300:
            break
    for part in (source, sink, again):
        part.close()
    err = capsys.readouterr().err
    assert err.count("trying again until it works") == err.count("connected again") == 2


def test_a_frozen_broker_holds_a_write_up_for_a_bounded_time(broker: Broker, machine: Machine) -> None:
    sink = open_sink(broker.address, machine)
    sink.write(CORRECTION)
    broker._process.send_signal(signal.SIGSTOP)
    try:
        with pytest.raises(WorkError, match="does not confirm"):
            sink.write(CORRECTION)
    finally:
        broker._process.send_signal(signal.SIGCONT)

    def delivered() -> bool:
        try:
            sink.write(CORRECTION)
        except WorkError:
            return False
        return True

    eventually(delivered, "the sink does not recover")
    sink.close()


def test_no_broker_is_a_work_error_and_silence(
    broker: Broker, machine: Machine, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mqtt, "_FIRST_CONNECTION_S", 0.3)
    broker.stop()
    source, sink = open_source(broker.address, machine), open_sink(broker.address, machine)
    with pytest.raises(WorkError, match=r"cannot be reached .*dropped; check the broker"):
        sink.write(CORRECTION)
    assert next(source.samples()) is None
    source.close()
    sink.close()
    assert capsys.readouterr().err.count("cannot be reached") == 2


def test_user_and_password_come_from_the_environment(
    machine: Machine,
    start_broker: Callable[[str], Broker],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    passwords = tmp_path / "passwords"
    made = shutil.which("mosquitto_passwd")
    if made is None:
        pytest.skip("needs mosquitto_passwd: apt-get install mosquitto")
    subprocess.run([made, "-b", "-c", str(passwords), "mill", "secret"], check=True, capture_output=True)
    passwords.chmod(0o644)
    broker = start_broker(f"allow_anonymous false\npassword_file {passwords}\n")
    refused = open_sink(broker.address, machine)
    with pytest.raises(WorkError, match=r"refused by the broker .*THERMODRIFT_MQTT_USER"):
        refused.write(CORRECTION)
    refused.close()
    source = open_source(broker.address, machine)
    with pytest.raises(InputError, match=r"refused by the broker .*THERMODRIFT_MQTT_USER"):  # it does not run for ever
        for _ in source.samples():
            pass
    source.close()
    monkeypatch.setenv("THERMODRIFT_MQTT_PASSWORD", "secret")
    with pytest.raises(InputError, match="THERMODRIFT_MQTT_USER is not"):
        open_sink(broker.address, machine)
    monkeypatch.setenv("THERMODRIFT_MQTT_USER", "mill")
    sink = open_sink(broker.address, machine)
    sink.write(CORRECTION)
    sink.close()


def test_tls_with_a_certificate_authority_of_the_plant(
    machine: Machine, start_broker: Callable[[str], Broker], tmp_path: Path
) -> None:
    openssl = shutil.which("openssl")
    if openssl is None:
        pytest.skip("needs openssl: apt-get install openssl")
    key, certificate = tmp_path / "key.pem", tmp_path / "certificate.pem"
    request = f"{openssl} req -x509 -newkey rsa:2048 -nodes -subj /CN=127.0.0.1 -addext subjectAltName=IP:127.0.0.1"
    files = ["-keyout", str(key), "-out", str(certificate)]
    subprocess.run([*request.split(), *files], check=True, capture_output=True)
    key.chmod(0o644)
    broker = start_broker(f"allow_anonymous true\ncertfile {certificate}\nkeyfile {key}\n")
    address = broker.address.replace("mqtt://", "mqtts://")
    stranger = open_sink(address, machine)
    with pytest.raises(WorkError, match="certificate verify failed"):
        stranger.write(CORRECTION)
    stranger.close()
    sink = open_sink(f"{address}?ca={certificate}", machine)
    sink.write(CORRECTION)
    sink.close()
