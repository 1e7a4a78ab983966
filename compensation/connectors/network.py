"""What the connectors of a network share: addresses, a link that is kept up, one feed of samples, one delivery."""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import ClassVar, Generic, TypeVar
from urllib.parse import parse_qs, unquote, urlsplit

from compensation.connectors.messages import IDLE_S, check_deliverable, shown, warn
from compensation.contracts import Correction, Sample
from data.errors import InputError, WorkError, closest
from data.readers.cells import parse_number

_INBOX_SIZE = 1000
_UNTRIED = "not connected yet"


@dataclass(frozen=True)
class NetworkAddress:
    """A parsed ``SCHEME://HOST:PORT/PATH?KEY=VALUE``; `text` is the address without its query."""

    text: str
    scheme: str
    host: str
    port: int
    path: str
    query: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def parse(cls, address: str, default_port: int, keys: Collection[str], secrets: str) -> NetworkAddress:
        """Split and check an address; `keys` are the known query keys, `secrets` the start of the variables' names.

        Raises:
            InputError: a user or password in the address, no host, a wrong port, an unknown or repeated query key.
        """
        text = shown(address)
        parts = urlsplit(address)
        if "@" in parts.netloc:
            raise InputError(
                f"{text}: the address holds a user or a password, expected neither; "
                f"set {secrets}_USER and {secrets}_PASSWORD in the environment"
            )
        try:
            port = parts.port
        except ValueError:
            raise InputError(
                f"{text}: got the port {parts.netloc.rpartition(':')[2]!r}, expected 1 to 65535; correct it"
            ) from None
        if not parts.hostname or "#" in address:
            got = "'#'" if "#" in address else "no host"
            raise InputError(f"{text}: got {got}, expected {parts.scheme}://HOST:PORT/PATH; correct the address")
        try:
            query = parse_qs(parts.query, keep_blank_values=True, strict_parsing=bool(parts.query))
        except ValueError:
            raise InputError(f"{text}: the part after '?' cannot be read; expected KEY=VALUE&KEY=VALUE") from None
        for key, values in query.items():
            if key not in keys:
                raise InputError(f"{text}: unknown key {key!r} after '?': {closest(key, keys)}")
            if len(values) > 1:
                raise InputError(f"{text}: key {key!r} stands {len(values)} times after '?'; give it once")
        path = unquote(parts.path).strip("/")
        return cls(text, parts.scheme, parts.hostname, port or default_port, path, {k: v[0] for k, v in query.items()})

    def seconds(self, key: str, default_s: float) -> float:
        """A duration from the query, s.

        Raises:
            InputError: not a number above 0.
        """
        given = self.query.get(key)
        value = default_s if given is None else parse_number(given)
        if value is None or value <= 0:
            raise InputError(f"{self.text}: {key}: got {given!r}, expected a number of seconds above 0; correct it")
        return value


def credentials(secrets: str) -> tuple[str, str | None] | None:
    """User and password from the environment variables ``SECRETS_USER`` and ``SECRETS_PASSWORD``; None without a user.

    Raises:
        InputError: a password without a user.
    """
    user, password = os.environ.get(f"{secrets}_USER"), os.environ.get(f"{secrets}_PASSWORD")
    if not user and password:
        raise InputError(f"{secrets}_PASSWORD is set and {secrets}_USER is not; set both or neither")
    return (user, password) if user else None


class Link:
    """A connection that a thread of its own keeps up: a loss is reported once, and so is the next connection."""

    def __init__(self, address: NetworkAddress) -> None:
        self.address, self.where = address, address.text
        self.ready = threading.Event()
        self.settled = threading.Event()  # the first try has ended, well or not
        self.problem = _UNTRIED
        self.refused = ""  # why, before any connection: nothing will change by itself
        self.closed = False

    def up(self) -> None:
        """Note that the connection works."""
        if self.problem not in ("", _UNTRIED):
            warn(f"{self.where}: connected again")
        self.problem = self.refused = ""
        self.ready.set()
        self.settled.set()

    def lost(self, why: str, refused: bool = False) -> None:
        """Note a loss, or a try that failed; `refused`: by the other side."""
        self.refused = why if refused and self.problem == _UNTRIED else self.refused
        if self.problem in ("", _UNTRIED):  # the later ones are tries to connect again
            warn(f"{self.where}: {why}; trying again until it works")
        self.problem = why
        self.ready.clear()
        self.settled.set()

    def close(self) -> None:
        """End the connection, once."""
        if not self.closed:
            self.closed = True
            self.disconnect()

    def disconnect(self) -> None:
        """End the connection and its thread."""
        raise NotImplementedError


class Inbox:
    """Samples on their way from a connector's thread to the runtime; when full, the oldest go, with one report.

    Values that come one by one are collected from the first one on, the last of each channel counts, and make one
    sample at the end of their time. A whole sample takes readings that wait along.
    """

    def __init__(self, where: str, size: int = _INBOX_SIZE) -> None:
        self._where, self._size, self._full = where, size, False
        self._samples: deque[Sample] = deque()
        self._values: dict[str, float] = {}
        self._readings: dict[str, float] = {}
        self._due_s: float | None = None  # on the monotonic clock
        self._changed = threading.Condition()

    def put(self, sample: Sample) -> None:
        """Add a sample; never blocks."""
        with self._changed:
            self._add(sample)
            self._changed.notify_all()

    def collect(self, values: Mapping[str, float], readings: Mapping[str, float], for_s: float) -> None:
        """Add single values."""
        with self._changed:
            self._values |= values
            self._readings |= readings
            if self._due_s is None:
                self._due_s = time.monotonic() + for_s
            self._changed.notify_all()

    def _add(self, sample: Sample) -> None:
        if len(self._samples) >= self._size:
            self._samples.popleft()
            if not self._full:
                warn(f"{self._where}: {self._size} samples wait, the oldest are dropped; the runtime is too slow")
            self._full = True
        readings, self._readings = {**self._readings, **sample.readings_um}, {}
        self._samples.append(Sample(sample.time_s, sample.values, readings))

    def get(self, timeout_s: float) -> Sample | None:
        """The oldest sample, or None when none has come in time."""
        until_s = time.monotonic() + timeout_s
        with self._changed:
            while not self._samples:
                now_s = time.monotonic()
                if self._due_s is not None and now_s >= self._due_s:
                    values, self._values, self._due_s = self._values, {}, None
                    if values or self._readings:
                        self._add(Sample(time.time(), values))
                elif now_s >= until_s:
                    return None
                else:
                    self._changed.wait(min(until_s, self._due_s or until_s) - now_s)
            sample = self._samples.popleft()
            self._full = self._full and bool(self._samples)
            return sample


L = TypeVar("L", bound=Link)


class Feed(Generic[L]):
    """A source: samples that the thread of a link puts into an inbox."""

    def __init__(self, link: L) -> None:
        self.link, self.inbox = link, Inbox(link.where)

    def samples(self) -> Iterator[Sample | None]:
        """Samples as they come, None in silence; ends after `close`.

        Raises:
            InputError: the other side refuses the first connection.
        """
        while not self.link.closed:
            sample = self.inbox.get(IDLE_S)
            if self.link.refused:
                raise InputError(f"{self.link.where}: {self.link.refused}")
            if not self.link.closed:
                yield sample

    def close(self) -> None:
        """Disconnect; `samples` then ends."""
        self.link.close()


class Delivery(Generic[L]):
    """A sink: corrections over a link, at once or not at all, since a late correction is a wrong one."""

    peer: ClassVar[str]  # what to check where a correction is not delivered

    def __init__(self, link: L) -> None:
        self.link = link

    def write(self, correction: Correction) -> None:
        """Deliver one correction, and wait for the receipt for less than a second.

        Raises:
            WorkError: not connected, no receipt in time, a number is refused or not finite.
        """
        check_deliverable(correction, self.link.where)
        if self.link.closed or not self.link.ready.is_set():
            problem = "closed" if self.link.closed else self.link.problem or "not connected"
            raise WorkError(f"{self.link.where}: {problem}; the correction is dropped; check the {self.peer}")
        self.send(correction)

    def send(self, correction: Correction) -> None:
        """Deliver it. Raises: WorkError, as `write`."""
        raise NotImplementedError

    def send_off(self) -> None:
        """Deliver the state `off`. Raises: WorkError, as `write`."""
        raise NotImplementedError

    def close(self) -> None:
        """Deliver the state `off` and disconnect."""
        if not self.link.closed and self.link.ready.is_set():
            try:
                self.send_off()
            except WorkError as error:
                warn(f"{error}; the state 'off' is not delivered")
        self.link.close()
