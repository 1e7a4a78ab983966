"""Candidates that cannot be switched off smoothly: what each would change is the difference of two simulations."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from data.errors import InputError, WorkError
from twin.calibration.descent import x_of
from twin.calibration.fit_problem import Array
from twin.compile import compile_network
from twin.diagnosis.proposals.candidate import Candidate
from twin.diagnosis.rounds.fitted import Fitted
from twin.diagnosis.scoring.carried import carried_nuisances, carried_z, on_network
from twin.diagnosis.scoring.filtered import square_sums
from twin.schema import TwinPart

SUSPECTS, PLAINLY = 2, 100.0  # pairs of sensors, and by what factor their mean squares together would fall


def differences(fitted: Fitted, proposed: Sequence[Candidate]) -> tuple[dict[str, list[Array]], dict[str, str]]:
    """By candidate the change (n_b,) of every batch's rows, in units of the given noise, at its usual values.

    The second mapping says why others are left out: they do not compile, or the recordings contradict them outright.
    """
    out: dict[str, list[Array]] = {}
    left_out: dict[str, str] = {}
    before = fitted.problem.residuals(fitted.x, fitted.state.nuisance)
    for c in proposed:
        if c.amplitudes or c.part is None:
            continue
        try:
            swap = c.mechanism == "sensor_swap"
            change = _exchanged(fitted, c, before) if swap else difference(fitted, c.applied(fitted.part), before)
        except (InputError, WorkError) as error:
            left_out[c.name] = str(error)
            continue
        if change is not None:
            out[c.name] = change
    return out, left_out


def difference(fitted: Fitted, part: TwinPart, before: Sequence[Array]) -> list[Array]:
    """What a changed twin part shows beyond the fit whose residuals are `before`, (n_b,) of every batch.

    Raises:
        InputError, WorkError: the part does not compile or cannot be simulated.
    """
    problem = on_network(fitted.problem, fitted.batches, compile_network(fitted.machine, part=part))
    x = x_of(problem.unknowns, carried_z(fitted.problem, problem, fitted.state.z))
    after = problem.residuals(x, carried_nuisances(fitted.problem, problem, fitted.state.nuisance))
    return [b - a for b, a in zip(before, after, strict=True)]


def suspects(fitted: Fitted, proposed: Sequence[Candidate]) -> list[Candidate]:
    """Sensors that would fit better under each other's names where the machine file's own values are, the best first.

    A fit bends all it can towards the wrong labels; before it, they are plainly wrong.
    """
    problem = fitted.problem
    x = x_of(problem.unknowns, np.zeros(len(problem.unknowns)))
    plain = problem.residuals(x, [np.zeros(q) for q in problem.nuisance_sizes])
    square = _squares(fitted, plain)
    out = []
    for c in proposed:
        if c.mechanism == "sensor_swap" and (change := _exchanged(fitted, c, plain)) is not None:
            other = _squares(fitted, [r - d for r, d in zip(plain, change, strict=True)])
            out.append((float(np.sum(np.log(square) - np.log(other))), c))
    return [c for ratio, c in sorted(out, key=lambda q: -q[0]) if ratio > np.log(PLAINLY)][:SUSPECTS]


def _squares(fitted: Fitted, rows: Sequence[Array]) -> Array:
    """Mean squares (K,) of each channel, at least the given noise's."""
    return np.asarray(np.maximum(square_sums(fitted.problem, rows) / np.maximum(fitted.rows, 1.0), 1.0))


def _exchanged(fitted: Fitted, c: Candidate, before: Sequence[Array]) -> list[Array] | None:
    """Two labels exchanged move no heat: the simulation is read the other way round; None if that fits worse."""
    assert c.part is not None and c.part.acts_on is not None
    one, other = (fitted.problem.channels.index(name) for name in c.part.acts_on)
    noise = fitted.problem.noise
    out, gain = [], 0.0
    for m, r in zip(fitted.problem.measured, before, strict=True):
        change = r * 0.0
        a, b = m.channel == one, m.channel == other
        if a.sum() == b.sum() and (m.row[a] == m.row[b]).all():
            shown_a, shown_b = m.value[a] - r[a] * noise[one], m.value[b] - r[b] * noise[other]
            change[a], change[b] = (shown_b - shown_a) / noise[one], (shown_a - shown_b) / noise[other]
        gain += float(r @ r - (r - change) @ (r - change))
        out.append(change)
    return out if gain > 0 else None
