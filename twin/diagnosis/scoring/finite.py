"""Candidates that cannot be switched off smoothly: what each would change is the difference of two simulations."""

from __future__ import annotations

from collections.abc import Sequence

from data.errors import InputError, WorkError
from twin.calibration.descent import x_of
from twin.calibration.fit_problem import Array
from twin.compile import compile_network
from twin.diagnosis.proposals.candidate import Candidate
from twin.diagnosis.rounds.fitted import Fitted
from twin.diagnosis.scoring.carried import carried_nuisances, carried_z, on_network
from twin.schema import TwinPart


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
