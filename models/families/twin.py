"""Family: thermal network of the machine file, calibrated on the training batches and run from the drivers."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Self

import numpy as np

from data.arrays import Array
from data.errors import InputError, WorkError
from data.machine import Machine
from features.design import Design
from models.base import Family, Plain
from models.numerics.batches import Recent, by_batch, only, too_few_rows
from models.numerics.twin_folds import Calibrated, Calibrations, TwinRun
from twin.compile import compile_network
from twin.network import Network

_FEW = 3  # training sets from which on a common start saves time


class Twin(Family):
    """The thermal network of the machine file, its free parameters fitted by MAP least squares on the training batches.

    A calibration takes the training batches' sensors and errors (`channels`; empty: all that the twin has, so that the
    error channels of a machine share one calibration), one row in `every_s`. A prediction knows the drivers and the
    surroundings alone: it starts in the steady state with the surroundings' first values, plus the mean
    deviation of the training batches' starts from that (`start` "usual"; "settled": without it), and runs free.
    `fitted`: the machine as JSON, the channels that drive it, parameters and their values, start_K by cell and its
    covariance over batches.
    A training batch that cannot be simulated is left out; a hole in a driver of a batch to predict is bridged.
    """

    key = "twin"
    summary = "physics twin, calibrated on the training batches, free-running from drivers and surroundings"
    source = "machine file; Mayr et al. (2012), CIRP Annals 61(2), sec. 4; MAP least squares, Tarantola (2005), ch. 3"
    uses_inputs = False
    needs_twin = True
    shares_targets = True
    rank = 30

    def __init__(self, every_s: float = 300.0, channels: tuple[str, ...] = (), start: str = "usual") -> None:
        super().__init__()
        if start not in ("usual", "settled"):
            raise InputError(f"family {self.key}: start is {start!r}, expected 'usual' or 'settled'")
        if not every_s > 0:
            raise InputError(f"family {self.key}: every_s is {every_s!r}, expected seconds above 0")
        self.every_s, self.channels, self.start = float(every_s), tuple(channels), start

    def fit_folds(self, design: Design, folds: Sequence[Sequence[int]]) -> list[Self]:
        """One fitted copy per fold; several begin at one fit on all of them, which does not change where they end.

        Raises:
            InputError: no twin part, a target that it lacks, no usable row, no batch that can be simulated, or a
                calibration that fails.
        """
        work = self._calibrations(design)
        if design.target and design.target not in (known := [e.channel for e in work.network.errors]):
            raise InputError(
                f"family {self.key}: the twin of {work.network.machine} has no error {design.target!r}, only "
                f"{', '.join(known) or 'none'}; add it under twin.errors, or leave the family out"
            )
        for fold in folds:
            usable = sum(int(np.isfinite(design.y_um[design.rows(k)]).sum()) for k in fold)
            if usable < 2:
                raise too_few_rows(self.key, design, fold, usable, 2)
        every = sorted({k for fold in folds for k in fold}) if len(folds) >= _FEW else None
        try:
            calibrated = [work.of(fold, every) for fold in folds]
        except WorkError as error:
            raise InputError(f"family {self.key}: {error}") from None
        text = _machine(self.key, design).model_dump_json()
        return [self._learned(design, self._plain(text, c)) for c in calibrated]

    def respond(self, design: Design, batches: Sequence[int]) -> list[Array]:
        """Error_um (n_k,) per batch, 0 at its start; NaN where a batch lacks a driver or surrounding."""
        some = only(design, batches)
        return self._outputs(some, TwinRun.of(self.network, some.batches), [self], [range(some.n_batches)])[0]

    def respond_folds(
        self, design: Design, fitted: Sequence[Self], wanted: Sequence[Sequence[int]]
    ) -> list[list[Array]]:
        return self._outputs(design, run_of(design, fitted[0].fitted["machine"]), fitted, wanted)

    def _outputs(
        self, design: Design, run: TwinRun, fitted: Sequence[Self], wanted: Sequence[Sequence[int]]
    ) -> list[list[Array]]:
        """What `respond_folds` gives, from a run of the design's batches."""
        return by_batch(design, self._simulated(run, fitted)[0].T, wanted)

    def n_parameters(self) -> int:
        """Free parameters of the network and one start per body."""
        return len(self.network.free) + len(self.network.bodies) if self.fitted else 0

    @property
    def network(self) -> Network:
        """The network that this model runs on, at the machine file's values."""
        return network_of(self.fitted["machine"])

    def values(self) -> Array:
        """The calibrated parameter values (n,), in the network's order."""
        return np.asarray(self.fitted["values"], float)

    def _plain(self, machine: str, c: Calibrated) -> Plain:
        network = network_of(machine)
        driven_by = [*network.drivers, *(s.channel for s in network.surroundings if s.channel)]
        driven_by += [name for s in network.surroundings for name in s.first]
        return {"machine": machine, "driven_by": list(dict.fromkeys(driven_by)),
                "parameters": [p.name for p in network.parameters], "values": c.values, "start_K": c.start_K,
                "start_cov_K2": c.start_cov_K2, "words": c.message}  # fmt: skip

    def _usual_K(self) -> Array:
        start = np.asarray(self.fitted["start_K"], float)
        return start if self.start == "usual" else np.zeros_like(start)

    def _simulated(self, run: TwinRun, fitted: Sequence[Self]) -> tuple[Array, Array]:
        """Error_um (F, n) and readings (F, n, sensors) on all rows of a run, of F fitted copies with one machine."""
        values, start_K = np.stack([f.values() for f in fitted]), np.stack([f._usual_K() for f in fitted])
        return run.rows(values, start_K, error_of(run.network, fitted[0].target))

    def _calibrations(self, design: Design) -> Calibrations:
        """Those of the design's batches, the same for every error channel that is learned from them."""
        machine = _machine(self.key, design).model_dump_json()

        def make() -> Calibrations:
            return Calibrations(Machine.model_validate_json(machine), design.batches, self.every_s, self.channels)

        return _CALIBRATIONS.of((machine, self.every_s, self.channels), design.batches, make)


def _machine(key: str, design: Design) -> Machine:
    """The machine whose twin is meant.

    Raises:
        InputError: the design knows no machine, or its file has no twin part.
    """
    if design.machine is None or design.machine.twin is None or not design.batches:
        name = design.machine.machine if design.machine else (design.batches[0].machine if design.batches else "?")
        raise InputError(
            f"family {key} needs the twin part of the machine file; add 'twin' to the file of {name}, "
            "or leave the family out"
        )
    return design.machine


@lru_cache(maxsize=8)
def network_of(machine: str) -> Network:
    """The network of a machine given as JSON."""
    return compile_network(Machine.model_validate_json(machine))


def error_of(network: Network, target: str) -> int:
    """The number of an error channel among those of a network."""
    return [e.channel for e in network.errors].index(target)


def run_of(design: Design, machine: str) -> TwinRun:
    """The design's batches ready for a network."""
    return _RUNS.of((machine,), design.batches, lambda: TwinRun.of(network_of(machine), design.batches))


_CALIBRATIONS: Recent[Calibrations] = Recent(2)
_RUNS: Recent[TwinRun] = Recent(4)
