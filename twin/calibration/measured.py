"""What batches measured of a network's channels, at the rows that a calibration uses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from data.batch import Batch
from data.errors import InputError, closest
from twin.network import Network

Array = NDArray[np.float64]

# A body or a well bonded sensor moves within minutes, and neighbouring samples repeat each other's rounding: rows
# nearer than this cost time and say next to nothing.
EVERY_S = 300.0


@dataclass(frozen=True)
class Measured:
    """One batch's usable values, channel by channel in time order; n values of C channels.

    `row` (n,) of the recording, `channel` (n,) and `value` (n,): K for sensors in degC, and for errors what is shown
    less the channel's first usable sample, which stands at row `first` (C,) and is no value of its own.
    """

    batch_id: str
    row: NDArray[np.int64]
    channel: NDArray[np.int64]
    value: Array
    first: NDArray[np.int64]
    is_error: NDArray[np.bool_]  # (C,)
    stride: int = 1  # rows of the recording from one that is used to the next

    @cached_property
    def usable(self) -> NDArray[np.int64]:
        """Numbers of the channels that have a value."""
        return np.unique(self.channel)

    @cached_property
    def usable_errors(self) -> NDArray[np.int64]:
        """Those of them that are errors."""
        return self.usable[self.is_error[self.usable]]

    @cached_property
    def at_rest(self) -> Array:
        """What would be shown (n,) if nothing ever moved from its first value."""
        out = np.zeros(len(self.value))
        for c in self.usable[~self.is_error[self.usable]].tolist():
            out[self.channel == c] = self.value[int(np.argmax(self.channel == c))]
        return out

    def of(self, series: Array) -> Array:
        """The same rows (..., n) of simulated channels (..., K, C), errors less their first sample."""
        seen = series[..., self.row, self.channel]
        error = self.is_error[self.channel]
        at = self.channel[error]
        seen[..., error] -= series[..., self.first[at], at]
        return np.asarray(seen)


def channels_of(network: Network, wanted: Sequence[str] | None = None) -> tuple[str, ...]:
    """The sensors and error channels of a network, or those of them that are wanted.

    Raises:
        InputError: an unknown channel, with the closest.
    """
    every = (*(r.channel for r in network.readings), *(e.channel for e in network.errors))
    for name in wanted or ():
        if name not in every:
            raise InputError(
                f"machine {network.machine}: the twin has no sensor or error {name!r}; {closest(name, every)}"
            )
    return tuple(n for n in every if wanted is None or n in wanted)


def measured(
    network: Network, batches: Sequence[Batch], every_s: float = EVERY_S, channels: Sequence[str] | None = None
) -> list[Measured]:
    """The usable values of each batch, one row every `every_s` or the recording's step, whichever is longer.

    Channels count in the order of `channels_of(network)`, sensors first; `channels` leaves out all others.

    Raises:
        InputError: an unknown channel, a step that is not above 0, or a batch with no usable value of any channel.
    """
    every = channels_of(network)
    wanted = set(channels_of(network, channels))
    if not every_s > 0:
        raise InputError(f"calibration: every_s: got {every_s:g}, expected seconds above 0, e.g. {EVERY_S:g}")
    out = []
    for batch in batches:
        values = [_values(batch, n) if n in wanted else np.full(batch.n_rows, np.nan) for n in every]
        out.append(_one(network, batch, values, max(1, round(every_s / (batch.step_s or every_s)))))
        if not len(out[-1].row):
            raise InputError(
                f"batch {batch.batch_id}: has no usable value of the channels that the twin of {network.machine} "
                f"measures ({', '.join(n for n in every if n in wanted)}); leave it out, or check its masks"
            )
    return out


def _values(batch: Batch, channel: str) -> Array:
    return batch.masked(channel) if channel in batch.table.columns else np.full(batch.n_rows, np.nan)


def _one(network: Network, batch: Batch, values: Sequence[Array], stride: int) -> Measured:
    sensors = len(network.readings)
    first = np.zeros(len(values), np.int64)
    rows, channels, shown = [], [], []
    for c, series in enumerate(values):
        usable = np.isfinite(series)
        if c >= sensors and usable.any():
            first[c] = int(np.argmax(usable))
            series = series - series[first[c]]
            usable[first[c]] = False
        at = np.flatnonzero(usable[::stride]) * stride
        rows.append(at)
        channels.append(np.full(len(at), c))
        shown.append(series[at])
    return Measured(
        batch.batch_id, np.concatenate(rows), np.concatenate(channels), np.concatenate(shown), first,
        np.arange(len(values)) >= sensors, stride,
    )  # fmt: skip
