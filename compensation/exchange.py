"""The machine's side of a conversation through MQTT: sends samples, waits for corrections. For rehearsals and tests."""

from __future__ import annotations

import json
from queue import Empty, SimpleQueue
from typing import Any
from urllib.parse import urlparse

import paho.mqtt.client as mqtt

from compensation.contracts import Correction, Sample
from data.errors import WorkError

_WAIT_S = 10.0


class MqttExchange:
    """Sends `PREFIX/sample` and waits for the `PREFIX/correction` of the same time.

    Raises:
        WorkError: the broker does not answer, or nobody compensates there.
    """

    def __init__(self, address: str) -> None:
        parts = urlparse(address)
        self.address, self.prefix = address, parts.path.strip("/")
        self._answers: SimpleQueue[dict[str, Any]] = SimpleQueue()
        self._ready: SimpleQueue[bool] = SimpleQueue()
        self._client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
        self._client.on_connect = lambda client, *_: client.subscribe(f"{self.prefix}/correction", 1)
        self._client.on_subscribe = lambda *_: self._ready.put(True)
        self._client.on_message = lambda _, __, message: self._answers.put(json.loads(message.payload))
        try:
            self._client.connect(parts.hostname or "127.0.0.1", parts.port or 1883)
            self._client.loop_start()
            self._ready.get(timeout=_WAIT_S)
        except (OSError, Empty) as error:
            raise WorkError(f"broker {address}: does not answer ({error}); start it, or give another address") from None

    def __call__(self, sample: Sample) -> Correction:
        message = {"time_s": sample.time_s, "values": dict(sample.values), "readings_um": dict(sample.readings_um)}
        self._client.publish(f"{self.prefix}/sample", json.dumps(message), 1)
        while True:
            try:
                got = self._answers.get(timeout=_WAIT_S)
            except Empty:
                raise WorkError(
                    f"{self.address}: no correction within {_WAIT_S:g} s; start `thermodrift compensate` with the same "
                    "address"
                ) from None
            if abs(got["time_s"] - sample.time_s) < 1e-3:
                return Correction(got["time_s"], got["offset_um"], got["slope_um_per_m"], got["state"], got["reasons"])

    def close(self) -> None:
        """Disconnects."""
        self._client.disconnect()
        self._client.loop_stop()
