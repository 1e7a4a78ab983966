"""The screen: every candidate's signature and left-out score from one linearisation at the baseline's best fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from data.batch import Batch
from data.machine import Machine
from twin.calibration.descent import State, x_of
from twin.calibration.fit_problem import Array
from twin.calibration.problem import CalibrationProblem
from twin.diagnosis.asleep import asleep
from twin.diagnosis.candidate import Candidate
from twin.diagnosis.carried import carried_nuisances, carried_z, on_network
from twin.diagnosis.evidence import Evidence
from twin.diagnosis.whitened import whitened
from twin.mechanisms import MECHANISMS
from twin.schema import TwinPart


@dataclass(frozen=True)
class Fitted:
    """A twin part at its best fit: the problem that its recordings pose and where the descent ended."""

    machine: Machine
    part: TwinPart
    batches: tuple[Batch, ...]
    problem: CalibrationProblem
    state: State

    @property
    def x(self) -> Array:
        return x_of(self.problem.unknowns, self.state.z)


@dataclass(frozen=True)
class Screen:
    """Candidates with a signature, their columns in the evidence, and those without one, with the reason."""

    candidates: tuple[Candidate, ...]
    columns: dict[str, tuple[int, ...]]
    evidence: Evidence
    left_out: dict[str, str]


def screen(fitted: Fitted, proposed: Sequence[Candidate]) -> Screen:
    """The evidence for all candidates that can be switched off, each amplitude a column."""
    found = asleep(fitted.machine, fitted.part, proposed)
    problem = on_network(fitted.problem, fitted.batches, found.network)
    numbers = {j: k for k, j in enumerate(found.network.free.tolist())}
    waking = sorted({j for js in found.amplitudes.values() for j in js})
    place = {j: c for c, j in enumerate(waking)}
    columns = [numbers[j] for j in waking]
    x = x_of(problem.unknowns, carried_z(fitted.problem, problem, fitted.state.z))
    z = fitted.state.z
    weight = fitted.state.noise.weight
    nuisance = carried_nuisances(fitted.problem, problem, fitted.state.nuisance)
    blocks = problem.linearise(x, nuisance)
    batches = tuple(
        whitened(block, own, z, problem.unknowns, columns, weight) for block, own in zip(blocks, nuisance, strict=True)
    )
    low, high = np.full(len(waking), -np.inf), np.full(len(waking), np.inf)
    kept = [c for c in proposed if c.name in found.amplitudes]
    for c in kept:
        for amplitude, j in zip(c.amplitudes, found.amplitudes[c.name], strict=False):
            spec = MECHANISMS[c.mechanism].spec(amplitude)
            off = c.amplitudes[amplitude]
            low[place[j]], high[place[j]] = spec.low - off, spec.high - off
    noise = fitted.state.noise
    rows = np.bincount(np.concatenate(fitted.state.channels), minlength=len(problem.channels))
    evidence = Evidence(batches, rows.astype(float), rows / noise.inflation, weight, low, high)
    names = {c.name: tuple(place[j] for j in found.amplitudes[c.name]) for c in kept}
    return Screen(tuple(kept), names, evidence, dict(found.left_out))

