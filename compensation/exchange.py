"""The machine's side of a conversation through MQTT: sends samples, waits for corrections. For rehearsals and tests."""

from __future__ import annotations

import json
import time
from queue import Empty, SimpleQueue
from typing import Any
from urllib.parse import urlparse

from compensation.connectors.mqtt import prompt_client
from compensation.contracts import Correction, Sample
from data.errors import WorkError

_WAIT_S, _AGAIN_S = 30.0, 1.0


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
        self._heard = False
        self._client = prompt_client()
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
        until_s, text, sent_s = time.monotonic() + _WAIT_S, json.dumps(message), -_AGAIN_S
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
            f"{self.address}: no correction within {_WAIT_S:g} s; start `thermodrift compensate --replay` with the "
            "same address"
        )

    def close(self) -> None:
        """Disconnects."""
        self._client.disconnect()
        self._client.loop_stop()
