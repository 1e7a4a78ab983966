"""Checks that compare batches: offset and swapped sensors, errors that no temperature explains, shared rows."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from data.batch import Batch, Finding
from data.checks.base import THERMAL, Array, Check, in_time, row_medians, smallest_step, span_text
from data.checks.expected import unexplained
from data.lakefile import MEASURED
from data.machine import Machine

_BATCHES = 5
_NEIGHBOURS = 3
_FLOOR_K = 3.0  # thermocouples of class 2 agree within ±2.5 K; more is a fault, less leaves the rises right
_SIGMAS = 8.0


class Offset(Check):
    """At its start a machine is nearly in equilibrium, so differences between neighbouring sensors repeat; at its end
    they repeat within what the load does.

    For each sensor the three others with the steadiest difference are its neighbours; a batch stands out when the
    median difference to them is off its median over the batches by 3 K and 8 robust sigma, at the start or at the end.
    It is masked where the channel follows the machine as in the other batches only if the straight line between the
    two is taken off (`unexplained`), and where it does not return: a part that starts warm cools.
    """

    key = "offset"
    summary = "level far off the neighbours, unlike in other batches"
    common_cause = "a normal state of this part, such as being heated"

    def habit(self, batch: Batch, finding: Finding) -> str:
        return "level"

    def across(self, batches: Sequence[Batch], machine: Machine) -> dict[int, list[Finding]]:
        names = batches[0].names(*THERMAL) if batches else ()
        if len(batches) < _BATCHES or len(names) < 2:
            return {}
        start, end = (np.array([[_level(b, n, at_end) for n in names] for b in batches]) for at_end in (False, True))
        found: dict[int, list[Finding]] = {}
        for j, name in enumerate(names):
            (first, limit, repeat), (last, most, _) = _off(start, j), _off(end, j)
            far = np.flatnonzero((np.abs(first) > limit) | (np.abs(last) > most)).tolist()
            if not far:
                continue
            as_read = np.abs(unexplained(batches, name, far))
            corrected = np.abs(unexplained(batches, name, far, [(first[k], last[k]) for k in far]))
            for k, read, line in zip(far, as_read.tolist(), corrected.tolist(), strict=True):
                starts = abs(first[k]) > limit
                stays = abs(last[k]) > (0.5 * abs(first[k]) if starts else most)
                masks = stays and read > _FLOOR_K and line < read / (2.0 if starts else 10.0)  # load moves an end
                if not starts and not masks:
                    continue  # an end that the machine explains
                message = (
                    f"{name} {'starts' if starts else 'ends'} {first[k] if starts else last[k]:+.1f} K off its level "
                    f"relative to its neighbours in the other batches (they repeat within {repeat:.2f} K)"
                )
                if not masks:
                    message += "; it then moves as the machine does, so the part was warm or cold: not masked"
                found.setdefault(k, []).append(self.finding(name, message, masks=masks))
        return found


def _off(level: Array, j: int) -> tuple[Array, float, float]:
    """Level of sensor j in (batches, sensors) relative to its neighbours and to the other batches, K; limit, spread."""
    difference = level[:, [j]] - np.delete(level, j, axis=1)
    difference = difference[:, np.isfinite(difference).sum(axis=0) >= _BATCHES]
    if not difference.shape[1]:
        return np.zeros(len(level)), np.inf, np.inf
    centred = difference - np.nanmedian(difference, axis=0)
    spread = 1.4826 * np.nanmedian(np.abs(centred), axis=0)
    near = np.argsort(spread, kind="stable")[:_NEIGHBOURS]
    repeat = float(np.median(spread[near]))
    return np.nan_to_num(row_medians(centred[:, near])), max(_FLOOR_K, _SIGMAS * repeat), repeat


def _level(batch: Batch, name: str, at_end: bool) -> float:
    """Median of the first or last three values within 10 min of the batch's start or end."""
    if name not in batch.channels:
        return float("nan")
    rows = max(3, int(600.0 / batch.step_s)) if batch.step_s else 3
    v = batch.masked(name)[:: -1 if at_end else 1][:rows]
    v = v[np.isfinite(v)]
    return float(np.median(v[:3])) if len(v) else float("nan")


_AT = (0.1, 0.25, 0.5, 1.0)  # of the batch's length
_LEAST_SPREAD = (0.3, *[0.04] * len(_AT))  # of a temperature's fingerprint: K, and shares of the typical rise
_SHARES = (0.05, 0.5, 0.95)
_MISFIT = 4.0
_FIT = 2.5


class Swapped(Check):
    """Each temperature has a fingerprint: start level and rises at four times, against the median of all sensors; each
    driver of more than two values those that it is below in a twentieth, a half and nineteen twentieths of the rows.

    Two channels are swapped in a batch where neither fits its own fingerprint (4 sigma rms) and each fits the other's
    (2.5 sigma). A temperature's is the median of the batches, with their robust sigma. A driver follows a programme:
    its is the range from the median lower to the median upper value, and sigma a tenth of that range.
    """

    key = "swapped"
    summary = "two channels have changed places"

    def across(self, batches: Sequence[Batch], machine: Machine) -> dict[int, list[Finding]]:
        found: dict[int, list[Finding]] = {}
        if len(batches) < _BATCHES:
            return found
        for roles, least, prints_of, usual in (
            (THERMAL, 3, _fingerprints, _median), (("driver",), 2, _levels, _range),
        ):  # fmt: skip
            names = list(batches[0].names(*roles))
            if len(names) < least:
                continue
            prints = np.array([prints_of(b, names) for b in batches])  # (K, p, f)
            for k, i, j in _swaps(prints, usual):
                message = (
                    f"{names[i]} behaves as {names[j]} does in the other batches and the other way round: their plugs "
                    "or columns have changed places"
                )
                found.setdefault(k, []).append(self.finding(names[i], message))
        return found


def _swaps(prints: Array, usual: Callable[[Array], tuple[Array, Array, Array]]) -> Iterator[tuple[int, int, int]]:
    """Batch and both channels, in either order, of each swap in fingerprints (K, p, f); `usual` gives what they are
    compared with: least and largest value, and sigma, each (p, f)."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a channel that no batch has is all NaN
        low, high, sigma = usual(prints)
    for k, own in enumerate(prints):
        # fit[i, j]: rms deviation of channel i from the fingerprint of channel j
        beyond = np.maximum(np.maximum(low[None] - own[:, None, :], own[:, None, :] - high[None]), 0.0)
        fit = np.sqrt(np.mean(np.minimum(beyond / sigma[None], 30.0) ** 2, axis=2))
        bad = [i for i in range(len(own)) if np.isfinite(fit[i, i]) and fit[i, i] > _MISFIT]
        for i, j in combinations(bad, 2):
            if fit[i, j] < _FIT and fit[j, i] < _FIT:
                yield from ((k, i, j), (k, j, i))


def _median(prints: Array) -> tuple[Array, Array, Array]:
    """Of temperatures: the median over the batches, and its robust sigma."""
    centre = np.nanmedian(prints, axis=0)
    return centre, centre, np.maximum(1.4826 * np.nanmedian(np.abs(prints - centre), axis=0), _LEAST_SPREAD)


def _levels(batch: Batch, names: list[str]) -> Array:
    """The values that each driver is below in 5, 50 and 95 % of the rows, (p, 3); NaN of a switch, whose two values say
    nothing about which one it is."""
    own = [batch.masked(n) if n in batch.channels else np.empty(0) for n in names]
    own = [v[np.isfinite(v)] for v in own]
    return np.array([np.quantile(v, _SHARES) if len(np.unique(v)) > 2 else [np.nan] * len(_SHARES) for v in own])


def _range(prints: Array) -> tuple[Array, Array, Array]:
    """Of drivers: the medians over the batches of the lowest and of the highest level, and a tenth of what is
    between them, or of a tenth of their size."""
    centre = np.nanmedian(prints, axis=0)
    low, high = centre[:, :1], centre[:, -1:]
    size = np.maximum(high - low, np.abs(centre).max(axis=1, keepdims=True) * 0.1)
    return low, high, 0.1 * size + 1e-12


def _fingerprints(batch: Batch, names: list[str]) -> Array:
    """Start level, K, and rises at the stated times as shares of the batch's typical largest rise: (p, 1 + times)."""
    out = np.full((len(names), 1 + len(_AT)), np.nan)
    rises = np.full((len(names), len(_AT)), np.nan)
    for i, name in enumerate(names):
        if name not in batch.channels:
            continue
        v = batch.masked(name)
        if not np.isfinite(v).all() or len(v) < 20 or smallest_step(batch, name) > 0.5:
            continue
        out[i, 0] = np.median(v[:3])
        for j, share in enumerate(_AT):
            row = int(share * (len(v) - 1))
            rises[i, j] = np.median(v[max(0, row - 1) : row + 2]) - out[i, 0]
    ok = np.isfinite(out[:, 0])
    if not ok.any():
        return out
    out[:, 0] -= np.median(out[ok, 0])
    typical = float(np.median(np.abs(rises[ok]).max(axis=1)))
    out[:, 1:] = rises / typical if typical > 0.5 else np.nan
    return out


_BATCHES_TO_COMPARE = 8
_UNEXPLAINED_SIGMAS = 6.0
_TIMES = 3.0
_FLOOR_UM = 20.0  # friction that scatters by 15 % moves 80 µm by 12 from batch to batch


class Unexplained(Check):
    """Ridge on the rises of all sound temperatures, each batch predicted by the others. A batch is reported when its
    residual exceeds the median over batches by 6 robust sigma, three times the median itself, and 20 µm.
    """

    key = "unexplained"
    summary = "the temperatures explain this batch's error far worse than the others'"

    def across(self, batches: Sequence[Batch], machine: Machine) -> dict[int, list[Finding]]:
        if len(batches) < _BATCHES_TO_COMPARE:
            return {}
        names = [
            n for n in batches[0].names(*THERMAL)
            if all(n in b.channels and np.isfinite(b.masked(n)).mean() > 0.8 for b in batches)
        ]  # fmt: skip
        if len(names) < 2:
            return {}
        x = [np.column_stack([b.masked(n) for n in names]) for b in batches]
        x = [v - v[:3].mean(axis=0) for v in x]
        found: dict[int, list[Finding]] = {}
        for target in in_time(batches[0], "error"):
            sums = _Sums(x, [b.masked(target) if target in b.channels else np.empty(0) for b in batches])
            odd: list[int] = []
            while len(odd) < len(batches) // 4:
                left = sums.left_out(odd)
                worst = int(np.nanargmax(np.where(np.isin(np.arange(len(left)), odd), -1.0, np.nan_to_num(left))))
                # a batch this odd bends the model for the others, so judge it by what they are without it
                left = sums.left_out([*odd, worst])
                usual = np.delete(left, [*odd, worst])
                usual = usual[np.isfinite(usual)]
                if len(usual) < _BATCHES_TO_COMPARE - 1:
                    break
                centre = float(np.median(usual))
                spread = 1.4826 * float(np.median(np.abs(usual - centre)))
                if not left[worst] > max(centre + _UNEXPLAINED_SIGMAS * spread, _TIMES * centre, _FLOOR_UM):
                    break
                odd.append(worst)
                message = (
                    f"{target}: a ridge model of the other batches leaves {left[worst]:.0f} µm here and "
                    f"{centre:.0f} µm in the median batch. No sensor explains it; look at the probe and its fixture. "
                    "Not masked: to leave it out of training, overrule with mask: true"
                )
                found.setdefault(worst, []).append(self.finding(target, message, masks=False))
        return found


class _Sums:
    """Cross-products of every batch, so that leaving some out costs one small solve."""

    def __init__(self, x: list[Array], errors: list[Array]) -> None:
        self.rows = []
        for xk, y in zip(x, errors, strict=True):
            ok = np.isfinite(y) & np.isfinite(xk).all(axis=1) if len(y) == len(xk) else np.zeros(len(xk), bool)
            self.rows.append((xk[ok], y[ok] - y[ok][0]) if ok.sum() > 10 else (xk[:0], np.empty(0)))
        scale = np.vstack([a for a, _ in self.rows]).std(axis=0) + 1e-9
        self.rows = [(a / scale, y) for a, y in self.rows]
        self.grams = np.array([a.T @ a for a, _ in self.rows])
        self.cross = np.array([a.T @ y for a, y in self.rows])
        self.counts = np.array([len(y) for _, y in self.rows])

    def left_out(self, never: list[int]) -> Array:
        """Rms residual of every batch predicted by all others but `never`, µm, shape (K,); NaN without values."""
        out = np.full(len(self.rows), np.nan)
        for k, (a, y) in enumerate(self.rows):
            train = np.setdiff1d(np.arange(len(self.rows)), [*never, k])
            if len(y) and len(train):
                ridge = 0.001 * self.counts[train].sum() * np.eye(a.shape[1])
                w = np.linalg.solve(self.grams[train].sum(axis=0) + ridge, self.cross[train].sum(axis=0))
                out[k] = float(np.sqrt(np.mean((y - a @ w) ** 2)))
        return out


_HASHED_ROWS = 16  # rows that are compared as one; noise does not repeat over so many
_HASHED_CHANGES = 8  # of them that differ from the row before: an idle machine may well rest at the same values twice
_MULTIPLIER = np.uint64(0x9E3779B97F4A7C15)  # 2^64 over the golden ratio, odd (Knuth, 1973, multiplicative hashing)


class Copied(Check):
    """Stretches of equal measured values in two batches, which a left-out batch has then been trained on: a recording
    that ends earlier or goes on longer than its copy, both of which ingest stores.

    Batches are compared by hashes of `_HASHED_ROWS` consecutive rows in all measured channels that every batch has. The
    earlier batch in the given order counts as the original. Rows are compared as they are on the grid: a copy that was
    cut, rounded or exported at another rate so that its rows on the grid are others is not found.
    """

    key = "copied"
    summary = "rows with the same measured values as in another batch"

    def across(self, batches: Sequence[Batch], machine: Machine) -> dict[int, list[Finding]]:
        shared = sorted(set.intersection(*map(_measured, batches))) if batches else []
        hashes = [_hashes(b, shared) for b in batches] if shared else []
        rows = [np.flatnonzero(h) for h in hashes]
        every = np.concatenate([h[r] for h, r in zip(hashes, rows, strict=True)]) if rows else np.empty(0, np.uint64)
        batch_of = np.repeat(np.arange(len(rows)), [len(r) for r in rows])
        _, first, group = np.unique(every, return_index=True, return_inverse=True)
        origin = batch_of[first][group]
        found = {}
        for k in np.unique(batch_of[origin != batch_of]).tolist():
            mine = batch_of == k
            copied = rows[k][origin[mine] != k]
            other = batches[Counter(origin[mine][origin[mine] != k].tolist()).most_common(1)[0][0]]
            n = len(np.unique(copied[:, None] + np.arange(_HASHED_ROWS)))
            batch, last = batches[k], int(copied[-1]) + _HASHED_ROWS - 1
            shorter = min(batch, other, key=lambda b: b.n_rows)
            message = (
                f"{n} of {batch.n_rows} rows, {span_text(batch, int(copied[0]), last)}, have the same measured values "
                f"as batch {other.batch_id}: a copy, or a longer export of the same run; withdraw the shorter one "
                f"(`thermodrift lake withdraw {batch.machine} {shorter.batch_id} --reason TEXT`)"
            )
            found[k] = [self.in_rows(batch, None, int(copied[0]), last, message, masks=False)]
        return found


def _measured(batch: Batch) -> set[str]:
    """Measured channels with a value."""
    return {n for n in batch.names(*MEASURED) if n in batch.table and np.isfinite(batch.values(n)).any()}


def _hashes(batch: Batch, names: Sequence[str]) -> NDArray[np.uint64]:
    """The hash of each row and the `_HASHED_ROWS` - 1 behind it, (n - _HASHED_ROWS + 1,); 0 where few change."""
    if batch.n_rows < _HASHED_ROWS:
        return np.zeros(0, np.uint64)
    row = np.zeros(batch.n_rows, np.uint64)
    for name in names:
        values = batch.values(name)
        bits = np.where(np.isnan(values), np.nan, values + 0.0).view(np.uint64)  # one NaN, and no -0.0
        row = (row ^ bits ^ (bits >> np.uint64(32))) * _MULTIPLIER
    out = np.zeros(batch.n_rows - _HASHED_ROWS + 1, np.uint64)
    for k in range(_HASHED_ROWS):
        out = (out ^ row[k : k + len(out)]) * _MULTIPLIER
    changes = np.concatenate([[0], np.cumsum(row[1:] != row[:-1])])
    return np.where(changes[_HASHED_ROWS - 1 :] - changes[: len(out)] >= _HASHED_CHANGES, out, np.uint64(0))
