"""Plausibility of temperature channels at the machine, and values in place of those that fail.

The rises r of all temperature channels of a run, values less their first, are taken as jointly Gaussian with mean 0.
Any channel then follows from any subset g of the others by the conditional mean

    E[r_i | r_g] = C_ig (C_gg)⁻¹ r_g,

where C is the second moment of training rises with the variance of noise on its diagonal. A substitute adds what this
predicts since the last good value, so that it continues from there. Its stated standard deviation is that of batches
that were left out of C.

The levels of the channels, over all runs and seasons, have such a regression too: a sensor that drifts, was exchanged
with another one or is off from the start contradicts it, and that of the largest standardised residual is the faulty
one (generalised likelihood ratio for a fault of one channel of unknown size: Willsky & Jones 1976, IEEE Trans. Autom.
Control 21, 108; parity relations on subsets: Frank 1990, Automatica 26, 459).

Conditional Gaussian: Rasmussen & Williams (2006), eq. A.6; the noise acts as the penalty of ridge regression.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import combinations
from typing import Any, Literal, NamedTuple, Self, get_args

import numpy as np
from numpy.typing import NDArray

from compensation.contracts import check_limits
from data.arrays import Array, Index, Mask
from data.batch import Batch
from data.checks.base import THERMAL, robust_sigma
from data.errors import InputError, one_of

Status = Literal["ok", "lost", "implausible", "stepping", "frozen", "off"]
STATUSES: tuple[Status, ...] = get_args(Status)

_LEAST_BATCHES = 2  # one is left out
_LEAST_ROWS = 3  # of a batch with all channels: a start, and a rise that changes
_NOISE_SHARES = (1e-5, 1e-4, 1e-3, 1e-2)  # noise variance tried, as a share of the mean square rise
_RATE_QUANTILE = 0.999  # of the rate of change in training: a few outliers are no usual change
_RATE_MARGIN = 3.0  # on that: a door or a coolant valve that training did not see
_NOISE_SD = 6.0  # standard deviations of noise that one sample does not exceed
_SECOND_DIFFERENCE = np.sqrt(6.0)  # sd of x[k-1] - 2 x[k] + x[k+1] per sd of independent x
HELD_MARGIN = 1.5  # on the longest constant stretch of training
_LEAST_SD_K = 1e-3  # below the resolution of any temperature sensor of a machine
_LEVEL_MARGIN = 2.0  # on the largest distance from the levels' regression in training runs that were left out
_LEAST_PARITY = 3  # channels: two that disagree do not say which of them is wrong
_MOST_OFF = 2  # channels at once, as two exchanged plugs; what more of them do has other causes
_MOST_KNOWN = 2000  # regressions kept: all pairs of sixty channels
_SAME_K = 1e-9  # equal but for rounding: a frozen value is repeated exactly
_FARTHEST_K = 1e4  # no machine is hotter; bounds channels without a range
_KEPT = ("filled", "used_s", "agreed", "same", "same_s", "moved_K")  # arrays of a `Watch` that a restart needs


@dataclass(frozen=True)
class GuardLimits:
    """When a channel counts as failed, and for how long it may be replaced.

    Attributes:
        substitute_s: time in total that a channel may be replaced, s; a good channel earns it back at the same pace.
            An hour suffices to finish the part and to call maintenance; the channels of `Substitutes.whole` have no
            such limit. It also bounds the pause between two samples after which the guard starts afresh, since no
            substitute reaches across a longer one.
        step_sd: change against the regression between two samples that is a step, in standard deviations. The standard
            deviation is that of whole runs, so 6 between two samples is far outside of what training shows.
        frozen_sd: change that the regression predicts while the value stays constant, in standard deviations.
        back_sd: distance to the substitute within which a channel counts as recovered, in standard deviations.
        back_samples: consecutive samples for which that must hold.
        bad_share: share of failed channels above which nothing is replaced any more: the regressions then rest on a
            minority, and a common cause such as the logger is likely.
    """

    substitute_s: float = 3600.0
    step_sd: float = 6.0
    frozen_sd: float = 5.0
    back_sd: float = 4.0
    back_samples: int = 5
    bad_share: float = 0.5

    def __post_init__(self) -> None:
        """Raises InputError where a limit is not finite or not above 0."""
        check_limits("limits of sensors", self)


@cache
def _sets(n: int, size: int) -> Index:
    """All sets of `size` of n places, (S, size)."""
    return np.array(list(combinations(range(n), size)), np.int64).reshape(-1, size)


class Regression(NamedTuple):
    """Weights (n, n), row i for channel i; what is usual of its distance, K, (n,), enlarged as far as the Gaussian
    loses precision without the channels that are not good; and the Gaussian's standard deviation, K, (n,)."""

    weights: Array
    usual_K: Array
    sd_K: Array

    def worst(self, off_K: Array, far: Mask) -> int:
        """The channel whose fault alone explains most of the distances: of the largest standardised one."""
        return int(np.argmax(np.where(far, np.abs(off_K) / self.sd_K, 0.0)))

    def misfits(self, good: Mask, rise_K: Array, size: int) -> Index:
        """The `size` good channels without which the rises (n,) of the other good ones misfit least.

        With P the precision of the good channels, the misfit r' P r falls by (P r)_S' P_SS⁻¹ (P r)_S without the set S
        (block inverse), so that no set needs a regression of its own.
        """
        at = np.flatnonzero(good)
        precision = (np.eye(len(at)) - self.weights[np.ix_(at, at)]) / self.sd_K[at, None] ** 2
        sets = _sets(len(at), size)
        pull = (precision @ rise_K[at])[sets]
        own = precision[sets[:, :, None], sets[:, None, :]]
        saved = np.einsum("si,si->s", pull, np.linalg.solve(own, pull[:, :, None])[:, :, 0])
        return at[sets[np.argmax(saved)]]


@dataclass(frozen=True)
class Substitutes:
    """What training knows of n temperature channels.

    Attributes:
        names: the channels.
        covariance_K2: second moment of their rises with the noise on the diagonal, K², (n, n).
        sd_K: standard deviation of each channel about its regression on all others, in left-out batches, K, (n,).
        rate_K_per_s: largest usual rate of change with its margin, K/s, (n,).
        held_s: longest time that a channel was constant while its regression moved by more than sd_K, s, (n,).
        low, high: plausible range, in the unit of the channels, (n,).
        resolution_K: smallest step shown, K, (n,); 0 where not known.
        step_s: step of the training grid, s.
        noise_K: standard deviation of the noise of a training row, K, (n,); None in models stored without it.
        level, level_K2, level_limit_K: mean of the channels' values over all runs, in their unit, (n,), covariance, K²,
            (n, n), and the largest usual distance of each from its regression on all others, K, (n,); None as above.
        whole: channels that may be replaced for a whole run, see `compensation.faults.bridged`.
    """

    names: tuple[str, ...]
    covariance_K2: Array
    sd_K: Array
    rate_K_per_s: Array
    held_s: Array
    low: Array
    high: Array
    resolution_K: Array
    step_s: float
    noise_K: Array | None = None
    level: Array | None = None
    level_K2: Array | None = None
    level_limit_K: Array | None = None
    whole: tuple[str, ...] = ()

    @classmethod
    def learn(cls, batches: Sequence[Batch], channels: Sequence[str]) -> Self:
        """From training batches; masked stretches are left out.

        Args:
            batches: at least 2 in which all channels are recorded together.
            channels: inputs of the model. Those that are neither `temperature` nor `ambient` are not guarded.

        Raises:
            InputError: an unknown channel, no temperature channel, or too few batches.
        """
        for name in channels:
            for batch in batches:
                batch.values(name)  # raises where a batch lacks it
        names = tuple(dict.fromkeys(n for n in channels if batches and batches[0].channels[n].role in THERMAL))
        runs = [run for batch in batches if len((run := _complete(batch, names))[0]) >= _LEAST_ROWS] if names else []
        if len(runs) < _LEAST_BATCHES:
            raise InputError(
                f"substitutes of sensors: got {len(names)} temperature channel(s) among {', '.join(channels) or 'none'}"
                f" and {len(runs)} batch(es) in which all are recorded together, expected at least 1 channel and "
                f"{_LEAST_BATCHES} batches; give more batches or leave out channels with long gaps"
            )
        specs = [batches[0].channels[n] for n in names]
        resolution_K = np.array([s.resolution or 0.0 for s in specs])
        rises = [values - values[0] for _, values in runs]
        covariance_K2, left_out_K2 = _regularised(rises, resolution_K)
        sd_K = np.maximum(np.sqrt(left_out_K2), np.maximum(resolution_K / 2, _LEAST_SD_K))
        step_s = max(float(np.median(np.diff(time_s))) for time_s, _ in runs)
        rate = np.concatenate([np.abs(np.diff(v, axis=0)) / np.diff(t)[:, None] for t, v in runs])
        usual = _RATE_MARGIN * np.quantile(rate, _RATE_QUANTILE, axis=0)
        held = [_held_s(t, r, r - _residual(covariance_K2, r), sd_K) for (t, _), r in zip(runs, rises, strict=True)]
        low = np.array([-_FARTHEST_K if s.low is None else s.low for s in specs])
        high = np.array([_FARTHEST_K if s.high is None else s.high for s in specs])
        values = [v for _, v in runs]
        return cls(
            names, covariance_K2, sd_K, np.maximum(usual, resolution_K / step_s), np.max(held, axis=0), low, high,
            resolution_K, step_s, _noise_K(values, resolution_K), *_levels(values, resolution_K),
        )  # fmt: skip

    def usual_K(self, dt_s: float) -> Array:
        """Largest usual change, K, (n,), between two samples that are `dt_s` apart.

        Within a step of the training grid a body changes by its rate, and a sample by its noise: a row of training is
        the mean of `step_s`, so that white noise of a sample is larger by the root of the ratio of the times.
        """
        widest = self.rate_K_per_s * max(dt_s, self.step_s)
        if self.noise_K is not None and 0.0 < dt_s < self.step_s:
            noise_K = _NOISE_SD * self.noise_K * np.sqrt(self.step_s / dt_s)
            widest = np.minimum(widest, self.rate_K_per_s * dt_s + noise_K)
        return np.asarray(widest + 2 * self.resolution_K)

    def changes(self, good: Mask) -> Regression:
        """Of the rises of every channel on those of the good ones (n,) other than itself."""
        return _regression(self.covariance_K2, self.sd_K, self._full_K2, good)

    def levels(self, good: Mask) -> Regression:
        """The same of the levels."""
        assert self.level_K2 is not None and self.level_limit_K is not None
        return _regression(self.level_K2, self.level_limit_K, self._full_level_K2, good)

    def without(self, name: str, batch: Batch) -> Array:
        """Values (n,) of a channel that never arrives in a run, as the guard replaces it: its level at the first sample
        by the levels of the others, and from there on its rise by theirs; NaN where one of these is masked."""
        assert self.level is not None
        others = np.array([n != name for n in self.names])
        at = self.names.index(name)
        values = np.column_stack([batch.masked(n) for n in self.names])
        rise_K = np.where(others, values - values[0], 0.0)
        off_K = np.where(others, values[0] - self.level, 0.0)
        start = self.level[at] + self.levels(others).weights[at] @ off_K
        return np.asarray(np.clip(start + rise_K @ self.changes(others).weights[at], self.low[at], self.high[at]))

    def as_plain(self) -> dict[str, Any]:
        """Numbers, strings and arrays."""
        known = {name: getattr(self, name) for name in self.__dataclass_fields__}
        plain = {name: value for name, value in known.items() if value is not None}
        return {**plain, "names": list(self.names), "whole": list(self.whole)}

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> Self:
        """The inverse of `as_plain`; lists in place of arrays are read too."""
        optional = ("noise_K", "level", "level_K2", "level_limit_K")
        others = ("names", "step_s", "whole")
        fields = [k for k in cls.__dataclass_fields__ if k not in others and (k in plain or k not in optional)]
        arrays = {k: np.asarray(plain[k], float) for k in fields}
        whole = tuple(plain.get("whole", ()))
        return cls(names=tuple(plain["names"]), step_s=float(plain["step_s"]), whole=whole, **arrays)

    @cached_property
    def _full_K2(self) -> Array:
        """Variance of each channel given all others, (n,)."""
        return _conditional_K2(self.covariance_K2)

    @cached_property
    def _full_level_K2(self) -> Array:
        """The same of the levels."""
        assert self.level_K2 is not None
        return _conditional_K2(self.level_K2)


def _conditional_K2(c: Array) -> Array:
    return np.asarray(1.0 / np.diag(np.linalg.inv(c)))


def _regression(c: Array, usual_K: Array, full_K2: Array, good: Mask) -> Regression:
    """Of every channel on the good ones other than itself, by the covariance `c` of conditional variances `full_K2`."""
    at, rest = np.flatnonzero(good), np.flatnonzero(~good)
    weights, variance_K2 = np.zeros_like(c), np.diag(c).copy()
    if len(at):
        precision = np.linalg.inv(c[np.ix_(at, at)])
        own = np.diag(precision)
        weights[np.ix_(at, at)] = np.eye(len(at)) - precision / own[:, None]
        variance_K2[at] = 1.0 / own
        weights[np.ix_(rest, at)] = c[np.ix_(rest, at)] @ precision
        variance_K2[rest] -= np.einsum("ij,ij->i", weights[np.ix_(rest, at)], c[np.ix_(rest, at)])
    return Regression(weights, usual_K * np.sqrt(np.maximum(variance_K2 / full_K2, 1.0)), np.sqrt(variance_K2))


@dataclass(frozen=True)
class Watch:
    """State of a guard between two samples; arrays are (n,), NaN where nothing has arrived.

    Attributes:
        status: of each channel.
        filled: value returned last, measured or substituted.
        raw: value that arrived last, NaN where it was lost or implausible; unknown after a restart, since time stamps
            alone say how long that took.
        used_s: how long each channel has been replaced, s.
        agreed: consecutive samples for which a failed channel has been consistent.
        same: value that the channel has kept, `same_s` how long, s, and `moved_K` what the regression predicts for
            that time, K.
        time_s: time stamp of the last sample, s; None before the first.
        levels: whether levels are compared; not where the operator has stated that they are right.
    """

    status: tuple[Status, ...]
    filled: Array
    raw: Array
    used_s: Array
    agreed: Array
    same: Array
    same_s: Array
    moved_K: Array
    time_s: float | None = None
    levels: bool = True

    @cached_property
    def bad(self) -> Mask:
        return np.array([s != "ok" for s in self.status])

    def as_plain(self) -> dict[str, Any]:
        """Numbers, strings and lists; None where a value is not known."""
        arrays = {name: [None if np.isnan(v) else v for v in getattr(self, name).tolist()] for name in _KEPT}
        return {"status": list(self.status), "time_s": self.time_s, "levels": self.levels, **arrays}

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> Self:
        """The inverse of `as_plain`. Raises: InputError, an unknown status or arrays of different lengths."""
        status = tuple(one_of(str(s), STATUSES, "status of a channel") for s in plain["status"])
        arrays = {name: np.array([np.nan if v is None else float(v) for v in plain[name]]) for name in _KEPT}
        if lengths := {name: len(a) for name, a in arrays.items() if len(a) != len(status)}:
            raise InputError(
                f"state of a guard: got {lengths}, expected {len(status)} values, one for every status; delete the "
                "stored state, the guard then starts afresh"
            )
        time_s = None if plain["time_s"] is None else float(plain["time_s"])
        return cls(status, raw=np.full(len(status), np.nan), time_s=time_s, levels=bool(plain["levels"]), **arrays)


@dataclass(frozen=True)
class Checked:
    """One sample after the guard.

    Attributes:
        values: what the model may use: every value of the sample, failed channels replaced, in the unit that arrived.
        status: guarded channel → one of `STATUSES`.
        sd_K: replaced channel → standard deviation of its substitute, K.
        fault: why the values cannot be used; None where they can.
        reason: which channels are replaced, why and how well; empty where none is.
    """

    values: Mapping[str, float]
    status: Mapping[str, Status]
    sd_K: Mapping[str, float]
    fault: str | None
    reason: str


class Guard:
    """Checks sample after sample and replaces channels that fail.

    - `lost`: absent or NaN. One that never arrived begins at the level that the others predict, where it may be
      replaced for the whole run.
    - `implausible`: outside of the range of the channel, or infinite.
    - `stepping`: faster than ever usual in training, or suddenly away from its regression on the other good channels.
      Where several are, the worst is judged first and the others without it.
    - `frozen`: exactly constant for longer than in training, and than its grid's step, while the regression predicts a
      clear change.
    - `off`: farther from the regression of the levels than any training run was, as a sensor that drifts or was
      exchanged with another one. It is replaced by that regression.

    A failed channel is taken again after `back_samples` samples that change at a usual rate and agree with its
    substitute. Where the substitute itself cannot be trusted any more, because its time is spent or more than half of
    the channels failed together, a lost or implausible channel is taken again on its rate alone. A channel that steps
    or freezes then needs to agree nevertheless, or a fresh start by `begin`.

    A start, at first and after a long pause, rests on levels alone and ends with the first sample that can be used. The
    first sample after a restart is not judged by its rate where the regressions explain all channels.
    """

    def __init__(self, substitutes: Substitutes, limits: GuardLimits | None = None) -> None:
        self.substitutes = substitutes
        self.limits = limits or GuardLimits()
        self._whole = np.isin(substitutes.names, substitutes.whole)
        self._known: dict[tuple[str, bytes], Regression] = {}  # by the mask of good channels

    def begin(self, levels: bool = True) -> Watch:
        """State before the first sample; see `Watch.levels`."""
        n = len(self.substitutes.names)
        unknown, zero = np.full(n, np.nan), np.zeros(n)
        status: tuple[Status, ...] = ("ok",)
        return Watch(status * n, unknown, unknown, zero, zero, unknown, zero, zero, levels=levels)

    def step(self, watch: Watch, time_s: float, values: Mapping[str, float]) -> tuple[Watch, Checked]:
        """One sample: the state after it and the values to use.

        Args:
            watch: state before.
            time_s: time stamp of the sample, s. A step back counts as no time.
            values: channel → value. Channels that are not guarded pass through.

        Raises:
            InputError: `watch` belongs to other channels.
        """
        s, limits = self.substitutes, self.limits
        if len(watch.status) != len(s.names):
            raise InputError(
                f"state of a guard: got {len(watch.status)} channels, expected {len(s.names)} "
                f"({', '.join(s.names)}); delete the stored state, the guard then starts afresh"
            )
        dt_s = 0.0 if watch.time_s is None or not np.isfinite(time_s) else max(time_s - watch.time_s, 0.0)
        if dt_s > limits.substitute_s:
            watch, dt_s = self.begin(watch.levels), 0.0
        x = np.array([_number(values.get(name)) for name in s.names])
        status = np.array(watch.status, object)
        present = np.isfinite(x) & (x >= s.low) & (x <= s.high)
        before = watch.filled
        fresh = present & np.isnan(before)
        status[~present & ~watch.bad] = "implausible"
        status[np.isnan(x) & ~watch.bad] = "lost"
        usual_K, any_K = s.usual_K(dt_s), np.full(len(s.names), np.inf)
        good = present & ~watch.bad & ~fresh
        change_K = np.where(good, x - before, 0.0)
        if np.isnan(watch.raw).all() and (self._without_steps(good, change_K, any_K)[0] == good).all():
            usual_K = any_K
        good, (weights, sd_K, _) = self._without_steps(good, change_K, usual_K)
        status[present & ~watch.bad & ~fresh & ~good] = "stepping"
        predicted_K = weights @ np.where(good, x - before, 0.0)

        same = good & (np.abs(x - watch.same) <= _SAME_K)
        same_s = np.where(same, watch.same_s + dt_s, 0.0)
        moved_K = np.where(same, watch.moved_K + predicted_K, 0.0)
        frozen = same & (same_s > HELD_MARGIN * np.maximum(s.held_s, s.step_s))
        frozen &= np.abs(moved_K) > limits.frozen_sd * sd_K + s.resolution_K
        status[frozen] = "frozen"
        was_off = status == "off"
        compared = (good & ~frozen) | fresh | (was_off & present)
        agree, level, level_sd_K = self._without_off(compared, x, watch)
        status[compared & ~agree] = "off"
        off = status == "off"
        filled = np.where(off, level, np.where(frozen, watch.same + moved_K, before + predicted_K))
        begun = np.isnan(filled) & ~present & self._whole
        filled = np.where(begun, level, filled)
        filled = np.where(agree & ~was_off, x, np.clip(filled, s.low, s.high))

        failed = status != "ok"
        many = failed.mean() > limits.bad_share
        near = np.where(off, agree, np.abs(x - filled) <= limits.back_sd * sd_K + s.resolution_K)
        back, agreed = self._recovered(watch, status, x, present, near, usual_K, bool(many))
        status[back] = "ok"
        filled = np.where(back, x, filled)
        bad = failed & ~back
        used_s = np.where(bad, watch.used_s + dt_s, np.maximum(watch.used_s - dt_s, 0.0))
        kept = same | (bad & ~np.isnan(watch.same))  # a failed channel keeps the value at which it failed
        after = replace(
            watch, status=tuple(status), filled=filled, raw=np.where(present, x, np.nan), used_s=used_s, agreed=agreed,
            same=np.where(kept, watch.same, filled), same_s=same_s, moved_K=moved_K,
            time_s=float(time_s) if np.isfinite(time_s) else watch.time_s,
        )  # fmt: skip
        checked = self._checked(after, values, np.where(off | begun, level_sd_K, sd_K))
        return self.begin(watch.levels) if checked.fault and np.isnan(before).all() else after, checked

    def _without_steps(self, good: Mask, change_K: Array, usual_K: Array) -> tuple[Mask, Regression]:
        """Good channels that do not step, with the regression on them."""
        good = good & (np.abs(change_K) <= usual_K)
        while True:
            regression = self._regression(self.substitutes.changes, good)
            off_K = np.where(good, change_K - regression.weights @ np.where(good, change_K, 0.0), 0.0)
            steps = np.abs(off_K) > self.limits.step_sd * regression.usual_K + self.substitutes.resolution_K
            # One channel left has no regression: its change is judged by the rate alone.
            if not steps.any() or good.sum() < 2:
                return good, regression
            good = good.copy()
            good[regression.worst(off_K, steps)] = False

    def _without_off(self, good: Mask, x: Array, watch: Watch) -> tuple[Mask, Array, Array]:
        """Good channels whose levels agree, and the levels (n,) that these predict, with standard deviations, K; none
        and the last ones where more than `_MOST_OFF` would have to be wrong."""
        s = self.substitutes
        if s.level is None or not watch.levels or good.sum() < _LEAST_PARITY:
            return good, np.full(len(x), np.nan), s.sd_K
        agree, regression = self._agreeing(good, x)
        if not agree.any():
            return agree, np.where(np.isnan(watch.filled), x, watch.filled), regression.sd_K
        return agree, s.level + regression.weights @ np.where(agree, x - s.level, 0.0), regression.sd_K

    def _agreeing(self, good: Mask, x: Array) -> tuple[Mask, Regression]:
        """Without the fewest channels so that the rest agrees, and agrees best of as many; none where no rest does."""
        s = self.substitutes
        assert s.level is not None
        rise_K = np.where(good, x - s.level, 0.0)

        def judged(rest: Mask) -> tuple[bool, Regression]:
            regression = self._regression(s.levels, rest)
            left_K = np.where(rest, rise_K - regression.weights @ np.where(rest, rise_K, 0.0), 0.0)
            return bool((np.abs(left_K) <= regression.usual_K + s.resolution_K).all()), regression

        rest, (agrees, regression) = good, judged(good)
        every = regression
        for size in range(1, _MOST_OFF + 1):
            if agrees or good.sum() - size < _LEAST_PARITY - 1:
                break
            rest = good.copy()
            rest[every.misfits(good, rise_K, size)] = False
            agrees, regression = judged(rest)
        return rest & agrees, regression

    def _regression(self, of: Callable[[Mask], Regression], good: Mask) -> Regression:
        key = of.__name__, good.tobytes()
        if key not in self._known:
            if len(self._known) > _MOST_KNOWN:
                self._known.clear()
            self._known[key] = of(good)
        return self._known[key]

    def _recovered(
        self, watch: Watch, status: NDArray[np.object_], x: Array, present: Mask, near: Mask, usual_K: Array, many: bool
    ) -> tuple[Mask, Array]:
        """Which failed channels are taken again (n,), and the number of consistent samples of each (n,).

        A channel that returns with another value than its trusted substitute is marked as stepping in `status`.
        """
        limits = self.limits
        present = watch.bad & present
        steady = present & (np.abs(x - watch.raw) <= usual_K)
        spent = self._spent(watch)
        gone = (status == "lost") | (status == "implausible")
        stuck = (status == "frozen") & (np.abs(x - watch.same) <= _SAME_K)
        trusted = ~spent & (not many)
        status[steady & ~near & trusted & gone] = "stepping"
        first = present & np.isnan(watch.raw)  # nothing before it to judge its rate by
        consistent = (steady | first) & ~stuck & (near | (~trusted & gone))
        agreed = np.where(consistent, watch.agreed + 1, 0)
        return np.asarray(agreed >= limits.back_samples), agreed.astype(float)

    def _spent(self, watch: Watch) -> Mask:
        """Channels whose time with a substitute is over."""
        return np.asarray((watch.used_s > self.limits.substitute_s) & ~self._whole)

    def _checked(self, watch: Watch, values: Mapping[str, float], sd_K: Array) -> Checked:
        s, limits = self.substitutes, self.limits
        bad = np.flatnonzero(watch.bad)
        faults = [
            f"{s.names[i]} {watch.status[i]}: "
            + ("never arrived" if np.isnan(watch.filled[i]) else f"replaced for more than {limits.substitute_s:.0f} s")
            for i in bad
            if np.isnan(watch.filled[i]) or self._spent(watch)[i]
        ]
        if len(bad) > limits.bad_share * len(s.names):
            named = ", ".join(f"{s.names[i]} {watch.status[i]}" for i in bad)
            faults.insert(0, f"{len(bad)} of {len(s.names)} temperature channels failed ({named})")
        notes = [f"{s.names[i]} {watch.status[i]}, replaced (sd {sd_K[i]:.2g} K)" for i in bad]
        return Checked(
            values={**values, **dict(zip(s.names, watch.filled.tolist(), strict=True))},
            status=dict(zip(s.names, watch.status, strict=True)),
            sd_K={s.names[i]: float(sd_K[i]) for i in bad},
            fault="; ".join(faults) or None,
            reason="; ".join(notes),
        )


def _number(value: float | None) -> float:
    return float("nan") if value is None else float(value)


def _complete(batch: Batch, names: Sequence[str]) -> tuple[Array, Array]:
    """Times (m,) and values (m, n) of the rows in which every channel is known."""
    values = np.column_stack([batch.masked(name) for name in names])
    known = np.isfinite(values).all(axis=1)
    return batch.time_s[known], values[known]


def _residual(covariance_K2: Array, rises_K: Array) -> Array:
    """Rises (m, n) less the regression of each channel on all others."""
    precision = np.linalg.inv(covariance_K2)
    return np.asarray(rises_K @ precision / np.diag(precision))


def _regularised(rises_K: Sequence[Array], resolution_K: Array) -> tuple[Array, Array]:
    """Second moment with the noise that predicts left-out batches best, (n, n), and their mean squares, K², (n,).

    Every batch counts the same, however long it is.
    """
    moments = np.array([r.T @ r / len(r) for r in rises_K])
    total = moments.mean(axis=0)
    scale_K2 = max(float(np.diag(total).mean()), _LEAST_SD_K**2)
    best: tuple[float, Array, Array] | None = None
    for share in _NOISE_SHARES:
        noise = np.diag(resolution_K**2 / 12 + share * scale_K2)
        squares = [
            np.mean(_residual((len(moments) * total - own) / (len(moments) - 1) + noise, r) ** 2, axis=0)
            for own, r in zip(moments, rises_K, strict=True)
        ]
        left_out_K2 = np.mean(squares, axis=0)
        score = float(np.log(np.maximum(left_out_K2, _LEAST_SD_K**2)).sum())
        if best is None or score < best[0]:
            best = score, total + noise, left_out_K2
    assert best is not None
    return best[1], best[2]


def _levels(runs: Sequence[Array], resolution_K: Array) -> tuple[Array, Array, Array]:
    """Mean (n,), covariance with the noise that predicts left-out runs best, K², (n, n), and the largest usual distance
    of a channel from its regression in a run that was left out, K, (n,). Every run counts the same."""
    means, moments = np.array([v.mean(axis=0) for v in runs]), np.array([v.T @ v / len(v) for v in runs])

    def of(rows: Sequence[int], noise_K2: Array) -> tuple[Array, Array]:
        mean = means[rows].mean(axis=0)
        return mean, moments[rows].mean(axis=0) - np.outer(mean, mean) + np.diag(noise_K2)

    every = list(range(len(runs)))
    scale_K2 = max(float(np.diag(of(every, 0.0 * resolution_K)[1]).mean()), _LEAST_SD_K**2)
    best: tuple[float, Array, Array] | None = None
    for share in _NOISE_SHARES:
        noise_K2 = resolution_K**2 / 12 + share * scale_K2
        rest = [of([j for j in every if j != k], noise_K2) for k in every]
        left = [np.abs(_residual(c, v - mean)) for (mean, c), v in zip(rest, runs, strict=True)]
        score = float(sum(np.log(np.maximum(np.mean(r**2, axis=0), _LEAST_SD_K**2)).sum() for r in left))
        if best is None or score < best[0]:
            best = score, noise_K2, np.max([r.max(axis=0) for r in left], axis=0)
    assert best is not None
    return *of(every, best[1]), _LEVEL_MARGIN * np.maximum(best[2], _LEAST_SD_K)


def _noise_K(runs: Sequence[Array], resolution_K: Array) -> Array:
    """Standard deviation of the noise of a row, K, (n,), from second differences; at least that of rounding."""
    second = np.concatenate([np.diff(values, 2, axis=0) for values in runs])
    own = np.array([robust_sigma(v, r) for v, r in zip(second.T, resolution_K, strict=True)]) / _SECOND_DIFFERENCE
    return np.asarray(np.maximum(own, np.maximum(resolution_K / np.sqrt(12.0), _LEAST_SD_K)))


def _held_s(time_s: Array, rises_K: Array, predicted_K: Array, sd_K: Array) -> Array:
    """Longest time that each channel was constant while its regression moved by more than its sd, s, (n,)."""
    found = np.zeros(rises_K.shape[1])
    changed = np.abs(np.diff(rises_K, axis=0)) > _SAME_K
    for i in range(rises_K.shape[1]):
        edges = np.flatnonzero(changed[:, i])
        first, last = np.concatenate([[0], edges + 1]), np.concatenate([edges, [len(time_s) - 1]])
        moved = np.abs(predicted_K[last, i] - predicted_K[first, i]) > sd_K[i]
        found[i] = np.max((time_s[last] - time_s[first])[moved], initial=0.0)
    return found
