"""The screen: every candidate's signature and left-out score from one linearisation at the baseline's best fit."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import pandas as pd

from data.arrays import Array
from diagnosis.candidates.alternatives import alternatives
from diagnosis.candidates.discretisation import SLACK_MECHANISMS, from_run_to_run, slack
from diagnosis.candidates.library import candidates
from diagnosis.contracts import COLUMNS, Candidate, Fitted, Scored
from diagnosis.fitting.fitted import carried_nuisances, carried_z, on_network
from diagnosis.fitting.regression import Memory, Whitened
from diagnosis.policy import POLICY
from diagnosis.screening.evidence import Evidence
from diagnosis.screening.linearisation import Asleep, asleep, differences
from twin.calibration.fit_problem import Block, Unknown
from twin.calibration.least_squares import x_of
from twin.calibration.problem import unknown
from twin.mechanisms import MECHANISMS
from twin.quantity import Spec


@dataclass(frozen=True)
class Screen:
    """All candidates that have a signature, best first, the evidence and the reasons of those left out."""

    scored: tuple[Scored, ...]
    evidence: Evidence
    left_out: dict[str, str]

    def columns(self, loose: Collection[str]) -> dict[str, int]:
        """By name of a candidate its column, for those that have one and are not `loose`: their gain is an alarm."""
        names = ((s.candidate.name, s.column) for s in self.scored if s.column >= 0)
        return {name: column for name, column in names if name not in loose}


def proposed(fitted: Fitted) -> list[Candidate]:
    """All mechanisms at all places, and the alternatives that doubt the machine file's values.

    Lags and skews are screened by their slope alone: at a value of their own they would compete with the slack that
    every fit has for them. Only laws without a trace at their usual value are screened at others, and radiation goes to
    surroundings alone: the time of a screen and of its null grows with the number of candidates.
    """
    every = candidates(fitted.machine, fitted.part) + alternatives(fitted.problem.network)
    return [c for c in every if not (c.variant_of and c.mechanism not in SCANNED) and not _between_bodies(c, fitted)]


SCANNED = ("draught", "floor_sink")  # laws that are screened at several values of their shape


def _between_bodies(c: Candidate, fitted: Fitted) -> bool:
    at = c.part.at if c.mechanism == "radiation" and c.part is not None else None
    return isinstance(at, Mapping) and at.get("surrounding") in fitted.part.bodies


def screen(fitted: Fitted, every: Sequence[Candidate]) -> Screen:
    """The evidence for all candidates that can be switched off or whose value may be doubted."""
    return screens(fitted, every, [fitted.memory])[0]


def screens(fitted: Fitted, every: Sequence[Candidate], memories: Sequence[Memory]) -> list[Screen]:
    """The same with the rows' memory as given, from one linearisation."""
    line = _Line.at(fitted, every, slack(every, fitted))
    finite, refused = differences(fitted, every)
    low, high = _bounds(line, every)
    low, high = (
        np.append(low, np.zeros(len(finite))),
        np.append(high, np.full(len(finite), POLICY.finite_change_max_amplitude)),
    )
    out = []
    for memory in memories:
        batches = tuple(
            replace(b, columns=np.column_stack([b.columns, *(b.of(d[k]) for d in finite.values())]))
            for k, b in enumerate(line.whitened(memory))
        )
        evidence = _evidence(fitted, batches, memory, low, high)
        scored = _scored(line, every, list(finite), evidence)
        out.append(Screen(tuple(scored), evidence, {**line.found.left_out, **refused}))
    return out


def best_variants(scored: Sequence[Scored]) -> list[Scored]:
    """Of what was looked for at several values of its shape, the one that gains most."""
    return one_of_each(scored, lambda s: (-s.gain,))


def one_of_each(scored: Sequence[Scored], key: Callable[[Scored], tuple[float, ...]]) -> list[Scored]:
    """Of what was looked for at several values of its shape, the one that sorts first; in the same order."""
    first: dict[str, Scored] = {}
    for s in scored:
        own = s.candidate.plain
        if own not in first or key(s) < key(first[own]):
            first[own] = s
    kept = {s.candidate.name for s in first.values()}
    return [s for s in scored if s.candidate.name in kept]


def alone(fitted: Fitted, memory: Memory, like: Fitted | None = None) -> Evidence:
    """How well a fit predicts batches left out, with slack and no candidates; `memory` of the rows of what is
    compared.

    With `like` the slack's traces are those of that fit: near enough to rank, and half the time.
    """
    line = _slackened(fitted) if like is None else _slackened(like).under(fitted)
    batches = line.whitened(memory)
    return _evidence(fitted, tuple(replace(b, columns=b.columns[:, :0]) for b in batches), memory, *np.zeros((2, 0)))


def slackened(fitted: Fitted) -> list[Candidate]:
    """The candidates that are slack: what every fit may do by itself."""
    every = candidates(fitted.machine, fitted.part, SLACK_MECHANISMS) + alternatives(fitted.problem.network)
    loose = slack(every, fitted)
    return [c for c in every if c.name in loose]


@lru_cache(maxsize=8)
def _slackened(fitted: Fitted) -> _Line:
    """With nothing asleep but what is slack. The last fits' are kept: each is judged with several memories."""
    every = slackened(fitted)
    return _Line.at(fitted, every, slack(every, fitted))


@dataclass(frozen=True)
class _Line:
    """A linearisation with candidates asleep, and the parameter number of every column.

    The blocks' jacobians (n, p + C) have the columns of `unknowns`, first the fit's own.
    """

    found: Asleep
    blocks: tuple[Block, ...]
    nuisance: tuple[Array, ...]
    z: Array
    weight: Array
    unknowns: tuple[Unknown, ...]
    numbers: list[int]
    own: dict[str, int]  # parameters that the fit has already, by name
    loose: Mapping[int, float]  # prior sd of the columns that are slack

    @classmethod
    def at(cls, fitted: Fitted, every: Sequence[Candidate], sd: Mapping[str, float]) -> _Line:
        """`sd` of those that are slack, by name."""
        found = asleep(fitted.machine, fitted.part, every)
        problem = on_network(fitted.problem, fitted.batches, found.network)
        own = {u.name: k for k, u in enumerate(fitted.problem.unknowns)}
        waking = sorted({j for js in found.amplitudes.values() for j in js})
        numbers = [j for j in waking if found.network.parameters[j].name not in own]
        loose = {numbers.index(found.amplitudes[n][0]): s for n, s in sd.items() if n in found.amplitudes}
        z = carried_z(fitted.problem, problem, fitted.state.z)
        nuisance = carried_nuisances(fitted.problem, problem, fitted.state.nuisance)
        more = problem.columns(x_of(problem.unknowns, z), nuisance, numbers)
        own_sd = from_run_to_run(fitted)
        kept = fitted.problem.linearise(fitted.x, fitted.state.nuisance)  # from the fit
        return cls(
            found,
            tuple(
                replace(b, jacobian=np.hstack([b.jacobian, m]), nuisance=_with_own(b, own_sd))
                for b, m in zip(kept, more, strict=True)
            ),
            tuple(np.append(v, np.zeros(len(own_sd))) for v in fitted.state.nuisance),
            fitted.state.z,
            1.0 / fitted.noise.factor**2,
            (*fitted.problem.unknowns, *(unknown(found.network.parameters[j]) for j in numbers)),
            numbers,
            own,
            loose,
        )

    def under(self, fitted: Fitted) -> _Line:
        """The same columns with another fit of the same rows."""
        p, own_sd = len(self.own), from_run_to_run(fitted)
        kept = zip(fitted.problem.linearise(fitted.x, fitted.state.nuisance), self.blocks, strict=True)
        return replace(
            self,
            blocks=tuple(
                replace(b, jacobian=np.hstack([b.jacobian, o.jacobian[:, p:]]), nuisance=_with_own(b, own_sd))
                for b, o in kept
            ),
            nuisance=tuple(np.append(v, np.zeros(len(own_sd))) for v in fitted.state.nuisance),
            z=fitted.state.z,
            weight=1.0 / fitted.noise.factor**2,
            unknowns=(*fitted.problem.unknowns, *self.unknowns[p:]),
            own={u.name: k for k, u in enumerate(fitted.problem.unknowns)},
        )

    def whitened(self, memory: Memory) -> tuple[Whitened, ...]:
        columns = range(len(self.own), len(self.unknowns))
        return tuple(
            Whitened.at(b, v, self.z, self.unknowns, columns, self.weight, memory).with_slack(self.loose)
            for b, v in zip(self.blocks, self.nuisance, strict=True)
        )


def _with_own(b: Block, sd: Mapping[int, float]) -> Array:
    """A batch's nuisances (n, q) and, behind them, the unknowns that it may have of its own, of prior N(0, 1)."""
    return np.hstack([b.nuisance, b.jacobian[:, list(sd)] * np.array(list(sd.values()))])


def _evidence(fitted: Fitted, batches: tuple[Whitened, ...], memory: Memory, low: Array, high: Array) -> Evidence:
    return Evidence(batches, fitted.rows, memory.white / fitted.noise.factor**2, low, high)


def _bounds(line: _Line, every: Sequence[Candidate]) -> tuple[Array, Array]:
    """Of every column's amplitude, less the value at which it is off."""
    low, high = (
        np.full(len(line.numbers), -POLICY.doubted_value_max_log_factor),
        np.full(len(line.numbers), POLICY.doubted_value_max_log_factor),
    )
    place = {j: c for c, j in enumerate(line.numbers)}
    for c in every:
        for amplitude, j in zip(c.amplitudes, line.found.amplitudes.get(c.name, ()), strict=False):
            spec, off = MECHANISMS[c.mechanism].spec(amplitude), c.amplitudes[amplitude]
            low[place[j]], high[place[j]] = spec.low - off, spec.high - off
    return low, high


def _scored(line: _Line, every: Sequence[Candidate], finite: Sequence[str], evidence: Evidence) -> list[Scored]:
    scores = evidence.scores()
    place = {j: c for c, j in enumerate(line.numbers)}
    out = []
    for c in every:
        if c.name not in line.found.amplitudes and c.name not in finite:
            continue
        if c.change is not None and c.change.per_batch is not None:
            out.append(Scored(c, _varying(line, place, evidence, c), len(evidence.batches), 0.0, {}, 0.0, -1))
            continue
        columns = [place[j] for j in line.found.amplitudes.get(c.name, ())]
        columns = columns or [len(line.numbers) + finite.index(c.name)]
        best = max(columns, key=lambda k: scores.gain[k])
        amplitudes = dict(zip(c.amplitudes or ("factor",), scores.amplitude[columns].tolist(), strict=False))
        out.append(
            Scored(
                c, float(scores.gain[best]), int(scores.improved[best]), float(scores.absorbed[best]), amplitudes,
                float(scores.sd[best]), best,
            )
        )  # fmt: skip
    return sorted(out, key=lambda s: (-s.gain, s.candidate.name))


def _varying(line: _Line, place: Mapping[int, int], evidence: Evidence, c: Candidate) -> float:
    """What it gains that a value differs from run to run."""
    assert c.change is not None and c.change.per_batch is not None
    (j,) = line.found.amplitudes[c.name]
    p = line.found.network.parameters[j]
    if j in place:
        return evidence.own_gain([b.columns[:, place[j]] * c.change.per_batch for b in evidence.batches])
    k = line.own[p.name]
    return evidence.own_gain([b.jacobian[:, k] * c.change.per_batch / p.spread for b in evidence.batches])


NO_TRACE_SD = 1e100  # sd of an amplitude that changes nothing that was recorded


def limits(fitted: Fitted, seen: Screen, threshold: float) -> pd.DataFrame:
    """Columns of the table `limits`, most sensitive first within each mechanism.

    The amplitude whose expected gain, half its square over its variance given all that is recalibrated, reaches the
    threshold (the local power of a score test, Cox and Hinkley 1974, §9.3).
    """
    evidence = seen.evidence
    shadow = evidence.shadow
    own = np.sqrt(sum(np.einsum("np,np->p", b.jacobian, b.jacobian) for b in evidence.batches))
    names = [u.name for u in fitted.problem.unknowns]
    rows = []
    for s in one_of_each(seen.scored, _usual):
        c = s.candidate
        if s.column < 0 or c.mechanism not in MECHANISMS or not c.amplitudes:
            continue
        amplitude = max(s.amplitudes, key=lambda a: abs(s.amplitudes[a]))
        spec = MECHANISMS[c.mechanism].spec(amplitude)
        limit = s.sd * (np.sqrt(2.0 * threshold) + POLICY.limit_power_sd)
        by = int(np.argmax(np.abs(shadow[: len(names), s.column]) * own[: len(names)]))
        unseen = limit > max(abs(spec.low), abs(spec.high)) or not np.isfinite(limit)
        value, unit = np.nan if unseen else float(limit), _unit(fitted, c, spec)
        rows.append(
            (c.mechanism, c.where.kind, c.where.name, c.label, value, unit, s.absorbed,
             names[by] if s.absorbed > POLICY.limit_absorbed_share else "")
        )  # fmt: skip
    table = pd.DataFrame(rows, columns=list(COLUMNS["limits"]))
    digits = table.assign(size=np.log(table["limit"]).round(9))  # what differs by rounding alone is of equal size
    return digits.sort_values(["mechanism", "size", "name", "words"], ignore_index=True).drop(columns="size")


def _unit(fitted: Fitted, c: Candidate, spec: Spec) -> str:
    """The unit of an amplitude: "W/%" where it counts per unit of a driver in per cent."""
    drivers = c.part.drivers if c.part is not None else None
    if not spec.per or not drivers:
        return spec.unit
    channel = drivers if isinstance(drivers, str) else drivers.get(spec.per)
    unit = fitted.machine.channels[channel].unit if channel else "1"
    return spec.unit if unit == "1" else f"{spec.unit}/{unit}"


def _usual(s: Scored) -> tuple[float, ...]:
    """Sorts the one at the usual value of its shape first, or, where that has no trace, the most sensitive."""
    return s.sd > NO_TRACE_SD, bool(s.candidate.variant_of), s.sd
