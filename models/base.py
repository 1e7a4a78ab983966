"""Base class of the model families.

To add one: a class below `Family` in a file of its own and a line in `models/families/__init__.py`. It needs
`fit_design` and `respond`, or `fit_folds` and `respond_folds` where many folds share work. Predictions are 0 at a
batch's start whatever `respond` gives there; `started` is the design that the model is to be fitted on.
"""

from __future__ import annotations

import copy
from abc import ABC
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, Self, final

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from data.batch import Batch, Channel
from data.errors import InputError
from data.machine import Machine
from features.design import Design
from models.program import Builder, Program

_AT_ONCE = 1_000_000  # inputs of rows that are predicted together; families have up to thirty columns of each
Plain = dict[str, Any]  # str, int, float, list of those, or numpy array


class Family(ABC):
    """A model of one error channel. Options are constructor arguments; what is learned is in `fitted`.

    `fitted` is plain data (numbers, strings, lists, arrays), so a model is stored as JSON and arrays.

    An error is recorded relative to the batch's start, so a prediction is exactly 0 there: at the first row that has
    one, and along an axis throughout the first sweep (`Design.since_start`). `as_published` gives a copy with the
    level free, as most methods are published.
    """

    key: ClassVar[str]
    summary: ClassVar[str]
    source: ClassVar[str]
    uses_inputs: ClassVar[bool] = True  # False for baselines: every selector and n_tsp gives the same model
    closed_form: ClassVar[bool] = True  # False: iterative, so the grid takes a stated few n_tsp
    needs_twin: ClassVar[bool] = False  # True: only for machines whose file has a twin part
    needs_position: ClassVar[bool] = False  # True: only for error channels that are measured along an axis
    shares_targets: ClassVar[bool] = False  # True: error channels of one training set share most of the work
    on_request: ClassVar[bool] = False  # True: so slow that it competes only where it is named
    combines: ClassVar[bool] = False  # True: made of the other families' left-out predictions
    packages: ClassVar[tuple[str, ...]] = ()  # what it imports to learn that an installation may lack
    has_sd: ClassVar[bool] = False  # True: `sd_um` gives the predictive standard deviation
    rank: ClassVar[int] = 50  # simplicity for ties in the promotion rule: smaller is simpler

    def __init__(self) -> None:
        self.inputs: tuple[str, ...] = ()
        self.target: str = ""
        self.fitted: Plain = {}
        self.zero_start = True

    def as_published(self) -> Self:
        """A copy whose level is fitted too (an intercept): its prediction at a batch's start need not be 0."""
        other = copy.copy(self)
        other.zero_start = False
        return other

    def fit_design(self, design: Design, train: Sequence[int]) -> Self:
        """A new, fitted copy from the usable rows of the batches `train` of the design.

        Override this or `fit_folds`: each is by default given by the other.

        Raises:
            InputError: too few usable rows, with the batches and what is needed.
        """
        return self.fit_folds(design, [train])[0]

    def respond(self, design: Design, batches: Sequence[int]) -> list[Array]:
        """The model's output in µm (n_k,) for each batch, from the design's inputs (never its target), at any level.

        NaN where an input is missing, unless the family can bridge it. Override this or `respond_folds`.
        """
        return self.respond_folds(design, [self], [batches])[0]

    @final
    def predict_design(self, design: Design, batches: Sequence[int]) -> list[Array]:
        """Free-running error_um (n_k,) of each batch, 0 at its start; NaN as `respond` gives."""
        return self._from_start(design, batches, self.respond(design, batches))

    def fit_folds(self, design: Design, folds: Sequence[Sequence[int]]) -> list[Self]:
        """One fitted copy per fold (a fold is the training batches' indices), equal to `fit_design` fold by fold."""
        return [self.fit_design(design, fold) for fold in folds]

    def fit_subsets(
        self, designs: Sequence[Design], folds: Sequence[Sequence[Sequence[int]]]
    ) -> Iterator[list[Self] | InputError]:
        """`fit_folds` of several subsets of one design, in their order, each on folds of its own.

        A subset that cannot be fitted gives its error, so that the others are kept.
        """
        for design, own in zip(designs, folds, strict=True):
            try:
                yield self.fit_folds(design, own)
            except InputError as error:
                yield error

    def respond_folds(
        self, design: Design, fitted: Sequence[Self], wanted: Sequence[Sequence[int]]
    ) -> list[list[Array]]:
        """For each of F fitted copies the outputs (n_k,) of its batches `wanted[f]`, as `respond` gives."""
        return [f.respond(design, batches) for f, batches in zip(fitted, wanted, strict=True)]

    @final
    def predict_folds(
        self, design: Design, fitted: Sequence[Self], wanted: Sequence[Sequence[int]]
    ) -> list[list[Array]]:
        """For each of F fitted copies the predictions (n_k,) of its batches `wanted[f]`, as `predict_design` gives."""
        outputs = self.respond_folds(design, fitted, wanted)
        parts = zip(fitted, wanted, outputs, strict=True)
        return [f._from_start(design, batches, own) for f, batches, own in parts]

    def _from_start(self, design: Design, batches: Sequence[int], outputs: Sequence[Array]) -> list[Array]:
        if not self.zero_start:
            return list(outputs)
        return [design.since_start(values, k, self.target) for k, values in zip(batches, outputs, strict=True)]

    def started(self, design: Design) -> Design:
        """The design with inputs relative to each batch's start, as the target is; itself for a free level.

        Of a fitted family the target is its own, since the design of a prediction has none.
        """
        if not self.zero_start:
            return design
        if not design.target and self.target:
            design = replace(design, target=self.target, _columns=None, _parent=None)
        return design.started

    def fitting_S_um(self, design: Design, fitted: Sequence[Self], trained: Sequence[Sequence[int]]) -> Array | None:
        """Mean S (F,) of each copy on its batches `trained[f]` where it can be had without rows; None: predict them."""
        return None

    def sd_um(self, design: Design, batches: Sequence[int]) -> list[Array]:
        """Predictive standard deviation (n_k,) of a recorded value about the prediction, for families with `has_sd`.

        Raises:
            InputError: the family, or this choice of its options, has none.
        """
        raise InputError(
            f"family {self.key}: has no predictive standard deviation; choose one that has, e.g. gaussian_process"
        )

    def fit(
        self, train_batches: Sequence[Batch], inputs: Sequence[str], target: str, machine: Machine | None = None
    ) -> Self:
        """A new, fitted copy from whole batches; families of the physics need the machine file."""
        design = Design.build(train_batches, inputs, target, machine)
        return self.fit_design(design, range(design.n_batches))

    def predict(self, batch: Batch) -> Array:
        """Error_um (n,) of a batch from its inputs alone, relative to its start as the training targets were."""
        return self.predict_batches([batch])[0]

    def predict_batches(self, batches: Sequence[Batch]) -> list[Array]:
        """Error_um (n_b,) of several batches, as many in one design as memory holds."""
        found: list[Array] = []
        for some in _by_size(batches, _AT_ONCE // max(1, len(self.inputs))):
            design = Design.build(some, self.inputs, None)
            found += self.predict_design(design, range(design.n_batches))
        return found

    def program(self, channels: Mapping[str, Channel], step_s: float) -> Program:
        """The fitted model as operations with carried state, for rows `step_s` apart.

        Raises:
            InputError: the family has none, or the error channel depends on a position that it does not know.
        """
        spec = channels.get(self.target)
        if spec is not None and spec.position and not self.needs_position:
            raise InputError(
                f"family {self.key}: {self.target} is measured along {spec.position}, of which a step in time knows "
                "nothing; choose axis_coupled"
            )
        builder = Builder(channels, step_s)
        return builder.program(self.operations(builder), self.zero_start)

    @classmethod
    def has_program(cls) -> bool:
        """Whether the family can be written as a program."""
        return cls.operations is not Family.operations or cls.program is not Family.program

    def started_inputs(self, b: Builder) -> int:
        """The inputs as a node, relative to the batch's start as in `started`; as they are for a free level."""
        x = b.features(self.inputs)
        return b.since_first(x) if self.zero_start else x

    def operations(self, b: Builder) -> Sequence[int]:
        """The nodes of `program` that give what `respond` gives. Override this where the model is a program.

        Raises:
            InputError: the family has no such form.
        """
        from models.families import FAMILIES

        those = [key for key, family in FAMILIES.items() if family.has_program()]
        raise InputError(f"family {self.key} cannot be written as a program; those that can: {', '.join(those)}")

    def parts(self) -> list[Family]:
        """The fitted families that it is a sum of; none of most."""
        return []

    def n_parameters(self) -> int:
        """How many numbers were learned."""
        return int(sum(np.size(v) for v in self.fitted.values() if not isinstance(v, str)))

    def options(self) -> Plain:
        """The constructor's arguments of this object."""
        hidden = {"inputs", "target", "fitted", "zero_start"}
        return {k: v for k, v in vars(self).items() if k not in hidden and not k.startswith("_")}

    def as_plain(self) -> Plain:
        """Everything needed to predict elsewhere; `family_from_plain` reads it back."""
        return {"family": self.key, "options": self.options(), "inputs": list(self.inputs), "target": self.target,
                "zero_start": self.zero_start, "fitted": dict(self.fitted)}  # fmt: skip

    def _learned(self, design: Design, fitted: Plain) -> Self:
        """A copy of this object with inputs, target and learned numbers set."""
        other = copy.copy(self)
        other.inputs, other.target, other.fitted = design.inputs, design.target, fitted
        return other


def _by_size(batches: Sequence[Batch], most_rows: int) -> Iterator[list[Batch]]:
    """The batches in their order, so many together as have at most so many rows; one at least."""
    some: list[Batch] = []
    for batch in batches:
        if some and sum(b.n_rows for b in some) + batch.n_rows > most_rows:
            yield some
            some = []
        some.append(batch)
    if some:
        yield some


def family_from_plain(plain: Plain) -> Family:
    """The inverse of `Family.as_plain`; one without `zero_start` was stored with a free level.

    Raises:
        InputError: unknown family key.
    """
    from models.families import FAMILIES

    family: Family = FAMILIES[plain["family"]](**plain["options"])
    family.inputs, family.target = tuple(plain["inputs"]), plain["target"]
    family.fitted, family.zero_start = dict(plain["fitted"]), bool(plain.get("zero_start", False))
    return family


def inner_groups(group: NDArray[np.int64], parts: int = 4) -> NDArray[np.int64]:
    """Groups (n,) for choices inside a training set with batches `group` (n,): its batches; for fewer than 3 batches
    `parts` contiguous parts of each.

    A single batch has no batch to leave out, yet train-on-one must choose its penalty too.
    """
    ids, compact = np.unique(group, return_inverse=True)
    if len(ids) >= 3:
        return compact.astype(np.int64)
    out = np.empty(len(group), np.int64)
    for k in range(len(ids)):
        rows = np.flatnonzero(compact == k)
        out[rows] = parts * k + (np.arange(len(rows)) * parts) // max(1, len(rows))
    return out
