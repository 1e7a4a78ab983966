"""Signatures of candidates: what recordings would show of each, from one linearisation with all of them switched off.

Each candidate has the values that switch it off, so the simulation is the baseline's; the derivatives by its
amplitudes are its signatures (the first-order response, Lindley 1958's score direction).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from data.arrays import Array, Mask
from data.errors import InputError, WorkError
from data.machine import Machine
from diagnosis.candidates.alternatives import alternatives
from diagnosis.candidates.discretisation import SLACK_MECHANISMS, films_that_rise, slack
from diagnosis.candidates.library import candidates
from diagnosis.contracts import Candidate, CandidateKind, Point
from diagnosis.fitting.carried import carried_nuisances, carried_z, on_network
from twin.calibration.fit_problem import x_of
from twin.compile import compile_network
from twin.mechanisms import MECHANISMS
from twin.mechanisms.base import View
from twin.network import Heat, Law, Network
from twin.quantity import Value, convert
from twin.schema import TwinPart, several
from twin.simulation import Simulation, simulate

AMPLITUDE_OF = "candidate "  # a parameter's source that says whose amplitude it is
NEARLY_OFF = 1e-12  # where a share cannot be 0
EVEN_STEPS = 1e-6  # of the longest, by which steps of an even grid differ


@dataclass(frozen=True)
class DisabledNetwork:
    """`amplitudes` numbers, by candidate, the parameters that enable it; `left_out` says why a candidate has none."""

    network: Network
    amplitudes: Mapping[str, tuple[int, ...]]
    left_out: Mapping[str, str]


def with_disabled(machine: Machine, part: TwinPart, candidates: Sequence[Candidate]) -> DisabledNetwork:
    """The machine's network with all candidates that have amplitudes, each disabled."""
    smooth = [c for c in candidates if c.amplitudes]
    left_out: dict[str, str] = {}
    try:
        network = compile_network(machine, part=_with(part, smooth))
    except InputError:
        for c in smooth:
            try:
                compile_network(machine, part=_with(part, [c]))
            except InputError as error:
                left_out[c.name] = str(error)
        smooth = [c for c in smooth if c.name not in left_out]
        network = compile_network(machine, part=_with(part, smooth))
    names = {_instance(c) for c in smooth}
    network = _disabled(network, names)
    found: dict[str, list[int]] = defaultdict(list)
    parameters = list(network.parameters)
    by_mark: dict[tuple[str, str], list[Candidate]] = defaultdict(list)
    for c in smooth:
        for a in c.amplitudes:
            by_mark[_instance(c), a].append(c)
    for c in candidates:
        if c.change is None:
            continue
        j = network.index(c.change.parameter.name)
        if not parameters[j].free:  # in its own scale: what is doubted is a factor
            parameters[j] = replace(parameters[j], free=True, spread=1.0)
        found[c.name].append(j)
    for j, p in enumerate(parameters):
        if not p.source.startswith(AMPLITUDE_OF):
            continue
        instance, _, amplitude = p.source.removeprefix(AMPLITUDE_OF).partition(".")
        # a signed number, so that its derivative is not scaled to 0 at 0
        parameters[j] = replace(p, free=True, scale="linear", spread=1.0, low=-np.inf, high=np.inf, source="")
        for c in by_mark[instance, amplitude]:  # in errors that share an instance, each candidate has its own part
            if not p.name.startswith("errors.") or p.name.startswith(f"errors.{c.where.name}."):
                found[c.name].append(j)
    return DisabledNetwork(
        replace(network, parameters=tuple(parameters)), {k: tuple(v) for k, v in sorted(found.items())}, left_out
    )


def _with(part: TwinPart, candidates: Sequence[Candidate]) -> TwinPart:
    """All candidates in the twin part; those that write the same bodies for other errors share one instance."""
    groups: dict[str, list[Candidate]] = defaultdict(list)
    for c in candidates:
        groups[_instance(c)].append(c)
    mechanisms = dict(part.mechanisms)
    for name, members in groups.items():
        first = members[0]
        assert first.part is not None
        mechanism = MECHANISMS[first.mechanism]
        values = {**first.part.parameters, **{k: Value(value=v) for k, v in mechanism.null_values.items()}}
        for amplitude, off in first.amplitudes.items():
            near = mechanism.spec(amplitude).scale == "logit" and off <= 0
            values[amplitude] = Value(value=NEARLY_OFF if near else off, source=f"{AMPLITUDE_OF}{name}.{amplitude}")
        changed = first.part.model_copy(update={"parameters": values})
        if len(members) > 1:
            on = tuple(str(c.part.acts_on) for c in members if c.part is not None)
            changed = changed.model_copy(update={"acts_on": on})
        mechanisms[name] = changed
    return part.model_copy(update={"mechanisms": mechanisms})


def _instance(c: Candidate) -> str:
    """What it is called in the twin part: without the error where several errors may share what it writes."""
    if c.where.kind == "error" and "expand" in MECHANISMS[c.mechanism].effects():
        return c.name.replace(f"{c.mechanism}_{c.where.name}_", f"{c.mechanism}_", 1)
    return c.name


def _disabled(network: Network, names: set[str]) -> Network:
    """The network with the laws of these names disabled; heat that one of them multiplies stays enabled without it."""

    def put(law: Law) -> Law:
        return replace(law, disabled=True) if law.name in names else law

    heats: list[Heat] = []
    for heat in network.heats:
        enabled = tuple(f for f in heat.factors if f.name not in names)
        base = replace(heat, law=put(heat.law), factors=enabled)
        heats.append(base)
        heats += [replace(base, factors=(*enabled, put(f))) for f in heat.factors if f.name in names]
    return replace(
        network,
        heats=tuple(heats),
        factors=tuple(put(f) for f in network.factors),
        surroundings=tuple(replace(s, effects=tuple(map(put, s.effects))) for s in network.surroundings),
        readings=tuple(replace(r, effects=tuple(map(put, r.effects))) for r in network.readings),
        errors=tuple(
            replace(e, effects=tuple(map(put, e.effects)), readings=tuple(map(put, e.readings))) for e in network.errors
        ),
        starts=tuple((put(law), cells) for law, cells in network.starts),
    )


@dataclass(frozen=True)
class Signatures:
    """Derivatives and finite changes (n_b, C) of every batch's rows, in units of the given noise.

    `of` numbers the columns by candidate; those that are `whole` (C,) are changes, the others derivatives by
    amplitudes. `left_out` says why a candidate has none.
    """

    columns: list[Array]
    of: Mapping[str, tuple[int, ...]]
    whole: Mask
    left_out: Mapping[str, str]

    def joined(self, more: Signatures) -> Signatures:
        """These and others."""
        n = len(self.whole)
        of = {**self.of, **{name: tuple(n + k for k in own) for name, own in more.of.items()}}
        columns = [np.hstack([a, b]) for a, b in zip(self.columns, more.columns, strict=True)]
        return Signatures(columns, of, np.append(self.whole, more.whole), {**self.left_out, **more.left_out})


def signatures(at: Point, every: Sequence[Candidate], known: Signatures | None = None) -> Signatures:
    """Of candidates at a point; those that only change a parameter that is fitted anyway have none.

    What is `known` from a fit with fewer effects is taken over: a signature hardly depends on them.
    """
    if known is not None:
        new = [c for c in every if c.name not in known.of and c.name not in known.left_out]
        names = {c.name for c in every}
        kept = replace(known, of={n: c for n, c in known.of.items() if n in names})
        return kept.joined(signatures(at, new)) if new else kept
    found = with_disabled(at.machine, at.part, every)
    problem = on_network(at.problem, at.batches, found.network)
    fitted = {u.name for u in at.problem.unknowns}
    amplitudes = sorted({j for js in found.amplitudes.values() for j in js})
    numbers = [j for j in amplitudes if found.network.parameters[j].name not in fitted]
    x = x_of(problem.unknowns, carried_z(at.problem, problem, at.z))
    smooth = list(problem.columns(x, carried_nuisances(at.problem, problem, at.nuisance), numbers))
    finite, refused = differences(at, every)
    place = {j: k for k, j in enumerate(numbers)}
    of = {name: tuple(place[j] for j in js if j in place) for name, js in found.amplitudes.items()}
    of |= {name: (len(numbers) + k,) for k, name in enumerate(finite)}
    columns = [np.column_stack([s, *(d[b] for d in finite.values())]) for b, s in enumerate(smooth)]
    whole = np.arange(columns[0].shape[1]) >= len(numbers)
    return Signatures(columns, {n: c for n, c in of.items() if c}, whole, {**found.left_out, **refused})


def imperfections(at: Point) -> list[Array]:
    """What sensors and lengths of any machine are off by, (n_b, K) of every batch per sd of each."""
    every = candidates(at.machine, at.part, SLACK_MECHANISMS) + alternatives(at.problem.network)
    sd = slack(every, at)
    own = [c for c in every if c.name in sd and (c.amplitudes or c.change)]
    seen = signatures(at, own)
    which = [(seen.of[c.name][0], sd[c.name]) for c in own if c.name in seen.of]
    scale = np.array([s for _, s in which])
    return [x[:, [k for k, _ in which]] * scale for x in seen.columns]


def rising_films(at: Point) -> list[Array]:
    """What every film that rises with its temperature difference shows, (n_b, E) of every batch per sd of its size."""
    every = films_that_rise(at)
    seen = signatures(at, [c for c, _ in every])
    which = [(seen.of[c.name][0], sd) for c, sd in every if c.name in seen.of]
    scale = np.array([sd for _, sd in which])
    return [x[:, [k for k, _ in which]] * scale for x in seen.columns]


def differences(fitted: Point, proposed: Sequence[Candidate]) -> tuple[dict[str, list[Array]], dict[str, str]]:
    """By candidate the change (n_b,) of every batch's rows, in units of the given noise, at its usual values.

    The second mapping says why others are left out: they do not compile, or the recordings contradict them outright.
    """
    out: dict[str, list[Array]] = {}
    left_out: dict[str, str] = {}
    problem, nuisance = fitted.problem, fitted.nuisance
    before = problem.residuals(fitted.x, nuisance)
    run = simulate(problem.network, fitted.values, *problem.inputs_at(nuisance))
    for c in proposed:
        if c.amplitudes or c.part is None:
            continue
        try:
            if c.kind is CandidateKind.SENSOR_SWAP:
                change = _exchanged(fitted, c, before)
            elif MECHANISMS[c.mechanism].effects() == ("reading",) and c.part.at is None and not c.part.drivers:
                change = _read_otherwise(fitted, c, run)
            else:
                change = difference(fitted, c.applied(fitted.part), before)
        except (InputError, WorkError) as error:
            left_out[c.name] = str(error)
            continue
        if change is not None:
            out[c.name] = change
    return out, left_out


def difference(fitted: Point, part: TwinPart, before: Sequence[Array]) -> list[Array]:
    """What a changed twin part shows beyond the fit whose residuals are `before`, (n_b,) of every batch.

    Raises:
        InputError, WorkError: the part does not compile or cannot be simulated.
    """
    problem = on_network(fitted.problem, fitted.batches, compile_network(fitted.machine, part=part))
    x = x_of(problem.unknowns, carried_z(fitted.problem, problem, fitted.z))
    after = problem.residuals(x, carried_nuisances(fitted.problem, problem, fitted.nuisance))
    return [b - a for b, a in zip(before, after, strict=True)]


def _read_otherwise(fitted: Point, c: Candidate, run: Simulation) -> list[Array]:
    """A sensor or a clock moves no heat: the law reads the same simulation otherwise."""
    assert c.part is not None
    problem, mechanism = fitted.problem, MECHANISMS[c.mechanism]
    given = {k: convert(v.value, mechanism.spec(k).unit) for k, v in c.part.parameters.items()}
    p = {s.name: np.asarray(given.get(s.name, s.value)) for s in mechanism.parameters}
    steps = np.diff(run.time_s, axis=1)
    even = steps.size and np.ptp(steps) < EVEN_STEPS * steps.max()
    view = View(time_s=run.time_s, step_s=float(steps[0, 0]) if even else np.nan)
    series = np.concatenate([run.readings[0], run.errors[0]], axis=-1)
    out = [np.zeros(len(m.row)) for m in problem.measured]
    for name in several(c.part.acts_on):
        k = problem.channels.index(name)
        moved = np.asarray(mechanism().reading(series[..., k], view, p)) - series[..., k]
        for b, m in enumerate(problem.measured):
            at = m.channel == k
            first = moved[b, m.first[k]] if m.is_error[k] else 0.0
            out[b][at] = (moved[b, m.row[at]] - first) / problem.noise[k]
    return out


def _exchanged(fitted: Point, c: Candidate, before: Sequence[Array]) -> list[Array] | None:
    """Two labels exchanged move no heat: the simulation is read the other way round; None if no run has rows of both at
    the same times."""
    assert c.part is not None and c.part.acts_on is not None
    one, other = (fitted.problem.channels.index(name) for name in c.part.acts_on)
    noise = fitted.problem.noise
    out = []
    for m, r in zip(fitted.problem.measured, before, strict=True):
        change = r * 0.0
        a, b = m.channel == one, m.channel == other
        if a.sum() == b.sum() and (m.row[a] == m.row[b]).all():
            shown_a, shown_b = m.value[a] - r[a] * noise[one], m.value[b] - r[b] * noise[other]
            change[a], change[b] = (shown_b - shown_a) / noise[one], (shown_a - shown_b) / noise[other]
        out.append(change)
    return out if any(change.any() for change in out) else None
