"""Base class of sequence nets: a linear part with memory in closed form, and a trained net for its residual."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from data.errors import InputError
from data.registry import check_packages
from features.design import Design
from models.base import Family, Plain
from models.families.linear import Pool
from models.families.ridge import Ridge
from models.numerics.batches import steps_s, too_few_rows
from models.numerics.sequences import (
    FEWEST_BATCHES,
    LAG_STEPS,
    Sequences,
    Stack,
    Weights,
    alike,
    memory_columns,
    strides,
)

DEVICES = ("auto", "cpu", "cuda")
_LEAST_ROWS = 4
_LEAST_STEPS = 16  # of the longest training batch: short batches take a narrower spacing
_MOST_OFF = 0.05  # of a batch's spacing from the one that was learned
_STACK_VALUES = 500_000  # states of a stack: what fits a processor's cache
_SHARES = (0.3, 0.03)  # of the lags: how much weaker their columns are before the common penalty
_SHARE_OF_FEW = (0.01,)  # of one or two batches, which cannot separate memory from drift
_DIRECTIONS = 6  # leading principal directions of the inputs that have a memory
_WAITING_VALUES = 10_000_000  # of the inputs of stacks that wait to be joined


@dataclass(frozen=True)
class _Lesson:
    """A net's rows, where it belongs (subset, fold), and what is known of it before it is trained."""

    stack: Stack
    place: tuple[int, int]
    known: Plain


class SequenceNet(Family):
    """error_um(t) = linear part of the inputs and their lags (`models.numerics.sequences`) + share · Σ_j v_j h_j(t).

    h are the states of a net that runs along the batch from zero; no recorded error goes in. Batches are thinned to
    steps of `spacing_s` (20 min; less where the longest training batch would keep fewer than 16 steps), and the rows
    between are sequences of their own (`models.numerics.sequences`). Inputs are divided by their rms, never shifted: at
    rest they are 0 and the net answers 0. With `drivers` the driver channels are inputs too, averaged over a step.
    Holes of the inputs are bridged by the last value; a batch that lacks an input wholly is predicted NaN.

    Training: the linear part first, in closed form. The net learns the residual, in units of its rms, in one stack with
    the nets of all folds: `epochs` steps of Adam, the readout v solved in each. `decay` holds the weights to their
    start and `readout_decay` v to 0, both over the number of batches, which are the independent samples. `share` in 0 …
    1 is the least-squares factor on the predictions of two nets of half the batches each for the other half, so that a
    net that does not generalise to new batches is switched off. With fewer than 3 batches it is 0. There is no early
    stopping. The defaults were tuned on simulated years other than the sample year, with linear and nonlinear laws.
    """

    closed_form = False
    packages = ("torch",)
    rank = 80
    weights: ClassVar[tuple[str, ...]]  # names of the net's arrays

    def __init__(
        self,
        hidden: int = 6,
        epochs: int = 20,
        rate: float = 0.2,
        decay: float = 0.1,
        readout_decay: float = 0.03,
        spacing_s: float = 1200.0,
        drivers: bool = False,
        device: str = "auto",
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.hidden, self.epochs, self.rate = int(hidden), int(epochs), float(rate)
        self.decay, self.readout_decay = float(decay), float(readout_decay)
        self.spacing_s, self.drivers, self.device, self.seed = float(spacing_s), bool(drivers), str(device), int(seed)
        if self.device not in DEVICES:
            raise InputError(f"family {self.key}: device {device!r}; expected one of {', '.join(DEVICES)}")
        least = {"hidden": 1, "epochs": 1, "rate": 1e-6, "decay": 0, "readout_decay": 1e-6, "spacing_s": 1}
        for name, low in least.items():
            if not getattr(self, name) >= low:
                raise InputError(f"family {self.key}: {name}: got {getattr(self, name):g}, expected {low:g} or more")

    def n_states(self) -> int:
        """How many states are read out."""
        return self.hidden

    @abstractmethod
    def start(self, directions: Array) -> Weights:
        """Weights (S, …) to train from; directions (S, hidden, p) in the inputs have sums of rms 1."""

    @abstractmethod
    def states(self, xp: Any, weights: Weights, x: Any) -> Any:
        """States (S, U, T, B) of S nets along x (S, p, T, B); xp is numpy or torch."""

    def fit_folds(self, design: Design, folds: Sequence[Sequence[int]]) -> list[Self]:
        """All folds' nets trained as stacks of similar numbers of batches.

        Raises:
            InputError: fewer than 4 usable rows in a fold; drivers requested and none recorded.
        """
        (fitted,) = self.fit_subsets([design], [folds])
        if isinstance(fitted, InputError):
            raise fitted
        return fitted

    def fit_subsets(
        self, designs: Sequence[Design], folds: Sequence[Sequence[Sequence[int]]]
    ) -> Iterator[list[Self] | InputError]:
        """The same with nets of all subsets in common stacks, as far as their numbers of inputs agree."""
        lessons: list[_Lesson] = []
        errors: dict[int, InputError] = {}
        first = 0
        for d, (design, own) in enumerate(zip(designs, folds, strict=True)):
            try:
                lessons += self._lessons(design, own, d)
            except InputError as error:
                errors[d] = error
            if d + 1 == len(designs) or sum(lesson.stack.x.size for lesson in lessons) > _WAITING_VALUES:
                fitted = self._learn(lessons)
                for done in range(first, d + 1):
                    nets = [fitted[done, f] for f in range(len(folds[done]))] if done not in errors else []
                    yield errors.get(done) or [self._learned(designs[done], net) for net in nets]
                lessons, first = [], d + 1

    def respond_folds(
        self, design: Design, fitted: Sequence[Self], wanted: Sequence[Sequence[int]]
    ) -> list[list[Array]]:
        """Error_um (n_k,) per copy and batch.

        Raises:
            InputError: a batch whose step does not divide the steps that the net learned.
        """
        out: list[list[Array]] = [[] for _ in fitted]
        by_kind: dict[tuple[float, tuple[str, ...], int], list[int]] = {}
        for f, model in enumerate(fitted):
            key = (float(model.fitted["spacing_s"]), tuple(model.fitted["drivers"]), len(wanted[f]))
            by_kind.setdefault(key, []).append(f)
        lengths = np.diff(design.offsets)
        for (spacing_s, drivers, n_wanted), which in by_kind.items():
            sequences = Sequences.of(fitted[0].started(design), self._stride(design, spacing_s), drivers)
            at_once = max(1, _STACK_VALUES // max(1, self.hidden * n_wanted * sequences.row[0].size))
            for start in range(0, len(which), at_once):
                some = which[start : start + at_once]
                batches = np.array([wanted[f] for f in some], int)
                for f, rows in zip(some, self._run(sequences, [fitted[f] for f in some], batches), strict=True):
                    out[f] = [row[: lengths[k]] for k, row in zip(wanted[f], rows, strict=True)]
        return out

    def n_parameters(self) -> int:
        """Weights of the net and its readout, coefficients of the linear part, intercept where the level is free."""
        learned = (self.fitted[name] for name in (*self.weights, "readout_um", "linear_um"))
        return (not self.zero_start) + sum(int(np.size(values)) for values in learned)

    def _spacing(self, design: Design, fold: Sequence[int]) -> tuple[int, float]:
        """Rows per step of the net, and the step in s, that a fold is learned with."""
        steps = steps_s(design)[list(fold)]
        if not np.isfinite(steps).any():
            return 1, self.spacing_s
        longest_s = np.nanmax(steps * (np.diff(design.offsets)[list(fold)] - 1))
        stride = int(strides(design, min(self.spacing_s, longest_s / _LEAST_STEPS))[list(fold)].max())
        return stride, stride * float(np.nanmax(steps))

    def _stride(self, design: Design, spacing_s: float) -> int:
        """Rows per step of the net that learned steps of `spacing_s`."""
        rows, steps = strides(design, spacing_s), np.nan_to_num(steps_s(design), nan=spacing_s)
        off = np.abs(rows * steps / spacing_s - 1.0)
        if off.max(initial=0.0) > _MOST_OFF:
            k = int(off.argmax())
            raise InputError(
                f"family {self.key}: batch {design.batch_ids[k]} has a step of {steps[k]:g} s, the net learned steps "
                f"of {spacing_s:g} s; expected a step that divides these: resample the batch"
            )
        return int(rows.max(initial=1))

    def _lessons(self, design: Design, folds: Sequence[Sequence[int]], place: int) -> list[_Lesson]:
        """The linear part of every fold, and its residual for the nets."""
        if not design.inputs:
            raise InputError(
                f"family {self.key}: no inputs given for {design.target or 'the error'}; name at least one channel"
            )
        if self.drivers and not design.driver_names:
            raise InputError(
                f"family {self.key}: drivers=True, but batch {design.batch_ids[0]} has no driver channel; expected at "
                "least one, e.g. the spindle speed with role driver in the machine file; or set drivers=False"
            )
        drivers = design.driver_names if self.drivers else ()
        design = self.started(design)
        by_spacing: dict[tuple[int, float], list[int]] = {}
        for f, fold in enumerate(folds):
            by_spacing.setdefault(self._spacing(design, fold), []).append(f)
        out = []
        for (stride, spacing_s), which in by_spacing.items():
            sequences = Sequences.of(design, stride, drivers).for_training()
            rows = [int(sequences.known[list(folds[f])].sum()) for f in which]
            for f, got in zip(which, rows, strict=True):
                if got < _LEAST_ROWS:
                    raise too_few_rows(self.key, design, folds[f], got, _LEAST_ROWS)
            columns = memory_columns(sequences.x)
            coef, intercept_um = fit_memories(sequences, columns, [folds[f] for f in which], self.zero_start)
            rest_um = sequences.y_um[..., None] - columns @ coef.T - intercept_um
            frame = {"spacing_s": spacing_s, "drivers": list(drivers)}
            for i, f in enumerate(which):
                known = {"linear_um": coef[i], "intercept_um": float(intercept_um[i]), **frame, "n_rows": rows[i]}
                out.append(_Lesson(Stack.of(sequences, folds[f], rest_um[..., i]), (place, f), known))
        return out

    def _learn(self, lessons: Sequence[_Lesson]) -> dict[tuple[int, int], Plain]:
        """Learned numbers in each place: lessons of one shape are joined before they are trained."""
        out: dict[tuple[int, int], Plain] = {}
        by_shape: dict[tuple[int, int, int], list[_Lesson]] = {}
        for lesson in lessons:
            n_phases, _, p, n_steps, _ = lesson.stack.x.shape
            by_shape.setdefault((n_phases, n_steps, p), []).append(lesson)
        for (n_phases, n_steps, _), same in by_shape.items():
            # A stack holds what fits a processor's cache.
            most = _STACK_VALUES // (self.hidden * n_phases * n_steps)
            for group in alike([lesson.stack.x.shape[-1] for lesson in same], most):
                nets = self._trained(Stack.joined([same[i].stack for i in group]))
                out |= {same[i].place: same[i].known | net for i, net in zip(group, nets, strict=True)}
        return out

    def _trained(self, stack: Stack) -> list[Plain]:
        """What each net of a stack learned, for inputs in their own units."""
        check_packages("family", self)
        from models.numerics.torch_training import train  # torch takes a second to load; a prediction needs none

        drawn = np.random.default_rng(self.seed).normal(size=(self.hidden, stack.x.shape[2]))
        start = self.start(stack.unit_directions(drawn))
        share = np.zeros(len(stack.n_batches))
        weights, readout = start, np.zeros((len(share), self.n_states()))
        if stack.n_batches.min() >= FEWEST_BATCHES:
            weights, readout = train(self, stack, start)
            share = self._share(stack, start)
        weights["input"] = weights["input"] / stack.spread[:, None]
        readout_um = (share * stack.sigma_um)[:, None] * readout
        return [
            {"readout_um": readout_um[s], "share": float(share[s]), **{name: w[s] for name, w in weights.items()}}
            for s in range(len(share))
        ]

    def _share(self, stack: Stack, start: Weights) -> Array:
        """Least-squares factor in 0 … 1, (S,), of the predictions of nets of half the batches for the other half."""
        from models.numerics.torch_training import train

        halves = stack.halves()
        doubled = {name: np.concatenate([w, w]) for name, w in start.items()}
        weights, readout = train(self, halves, doubled)
        met, size = np.zeros(len(stack.n_batches)), np.zeros(len(stack.n_batches))
        for x, rest, known in zip(halves.x, halves.rest, halves.known, strict=True):
            x, rest, known = (np.roll(v, len(v) // 2, axis=0) for v in (x, rest, known))
            predicted = (readout[:, :, None, None] * self.states(np, weights, x)).sum(axis=1) * known
            met += (predicted * rest).sum(axis=(1, 2)).reshape(2, -1).sum(axis=0)
            size += (predicted**2).sum(axis=(1, 2)).reshape(2, -1).sum(axis=0)
        return np.clip(met / np.where(size > 0, size, 1.0), 0.0, 1.0)

    def _run(self, sequences: Sequences, fitted: Sequence[Self], batches: NDArray[np.int64]) -> Array:
        """Predictions (S, B, rows) of S fitted nets on batches (S, B), rows to the end of the longest batch."""
        learned = [model.fitted for model in fitted]
        linear, readout_um, *arrays = (
            np.stack([np.asarray(f[name], float) for f in learned])
            for name in ("linear_um", "readout_um", *self.weights)
        )
        x = sequences.x[batches]
        n_nets, n_batches, n_phases, n_steps, p = x.shape
        along = np.ascontiguousarray(x.transpose(0, 4, 3, 1, 2)).reshape(n_nets, p, n_steps, -1)
        with np.errstate(invalid="ignore"):
            states = self.states(np, dict(zip(self.weights, arrays, strict=True)), along)
        net = (readout_um[:, None] @ states.reshape(n_nets, readout_um.shape[1], -1)).reshape(n_nets, n_steps, -1)
        columns = memory_columns(x).reshape(n_nets, -1, linear.shape[1])
        rest = (columns @ linear[:, :, None]).reshape(n_nets, -1, n_steps).swapaxes(1, 2)
        intercept_um = np.array([f["intercept_um"] for f in learned])[:, None, None]
        rows = (net + rest + intercept_um).reshape(n_nets, n_steps, n_batches, n_phases)
        return rows.swapaxes(1, 2).reshape(n_nets, n_batches, -1)


def fit_memories(
    sequences: Sequences, columns: Array, folds: Sequence[Sequence[int]], zero_start: bool
) -> tuple[Array, Array]:
    """Ridge on the columns of the sequences' x: coefficients (F, (L + 1) p), µm per unit of x, and intercepts (F,).

    With `zero_start` the intercepts are 0: columns that are 0 at rest answer 0.

    The lags act on the 6 leading principal directions of the inputs. The penalty, and how much stronger it is on the
    lags, are chosen by leave-batch-out inside each fold; a fold of one or two batches has the lags' share fixed.
    """
    design = replace(sequences.as_design(columns), about_start=zero_start)
    coef, intercept_um = np.empty((len(folds), columns.shape[-1])), np.empty(len(folds))
    for few, shares in ((False, _SHARES), (True, _SHARE_OF_FEW)):
        which = [f for f, fold in enumerate(folds) if (len(fold) < 3) == few]
        ridge = _MemoryRidge(shares) if zero_start else _MemoryRidge(shares).as_published()
        for f, fitted in zip(which, ridge.fit_folds(design, [folds[f] for f in which]), strict=True):
            coef[f], intercept_um[f] = fitted.fitted["coef_um_per_K"], fitted.fitted["intercept_um"]
    return coef, intercept_um


class _MemoryRidge(Ridge):
    has_sd = False  # the nets do not, and it costs

    def __init__(self, shares: tuple[float, ...]) -> None:
        super().__init__()
        self.shares = shares

    def _path(self, pool: Pool) -> Array:
        p = pool.xx.shape[1] // (len(LAG_STEPS) + 1)
        leading = np.linalg.eigh(pool.xx[:, :p, :p])[1][:, :, : -_DIRECTIONS - 1 : -1]
        some = leading.shape[2]
        onto = np.zeros((len(pool.xx), pool.xx.shape[1], p + some * len(LAG_STEPS)))
        onto[:, :p, :p] = np.eye(p)
        for lag in range(len(LAG_STEPS)):
            onto[:, p * (lag + 1) : p * (lag + 2), p + some * lag : p + some * (lag + 1)] = leading
        paths = []
        for share in self.shares:
            onto[:, p:, p:] *= share
            back = np.swapaxes(onto, 1, 2)
            narrow = replace(pool, xx=back @ pool.xx @ onto, xy=(back @ pool.xy[:, :, None])[..., 0],
                             scale=np.ones(onto.shape[::2]))  # fmt: skip
            paths.append(onto @ super()._path(narrow) / pool.scale[:, :, None])
            onto[:, p:, p:] /= share
        return np.concatenate(paths, axis=2)

    def _setting(self, pool: Pool, chosen: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
        return {}
