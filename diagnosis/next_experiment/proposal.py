"""The next experiment: the run that separates tied explanations, or shows an effect that these runs leave possible."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import pandas as pd

from data.arrays import Array
from data.errors import InputError, WorkError
from diagnosis.fitting.fit import Fitted
from diagnosis.formatting import few, listed
from diagnosis.next_experiment.foreseen import Foreseen, begun, foreseen
from diagnosis.next_experiment.menu import Run, menu
from diagnosis.policy import POLICY
from diagnosis.search.claims import Round, Tried, explanations
from diagnosis.search.search import Search

NOTHING = "nothing else is missing"  # the alternative to effects that recordings leave possible
COLUMNS = ("run", "hours", "nats", "nats_per_hour", "sensor", "nats_with_sensor", "hardest")


@dataclass(frozen=True)
class Proposal:
    """A run that distinguishes alternatives: `separates` names them, `label` goes before "would distinguish them".

    `nats` is the least, over all ordered pairs, by which the truth is expected to fit better than the other, and
    `tied` the pairs that no run separates. `plan_text` is a run plan file and `sensor` the body that needs one more
    sensor, if any. Where nothing does, `label` and `plan_text` are empty and nats are those of the best run.
    `table` has the whole menu, columns `COLUMNS`; `hardest` is the pair that the run separates least.
    """

    separates: tuple[str, ...]
    label: str
    hours: float
    nats: float
    nats_per_hour: float
    plan_text: str
    sensor: str | None
    tied: tuple[tuple[str, str], ...]
    table: pd.DataFrame

    @property
    def sentence(self) -> str:
        """What is proposed, or that nothing does and how near the best run comes."""
        if not len(self.table):
            return "No run is known that would distinguish them: no driver is set by the shop and no room is recorded."
        if not self.label:
            best = self.table.iloc[int(self.table["nats"].argmax())]
            return (
                f"None of {len(self.table)} runs would distinguish them: the best, {best['run']}, is expected to give "
                f"{few(self.nats)} nats, and {POLICY.negligible_nats:g} is the least that counts."
            )
        enough = "which is decisive" if self.nats >= POLICY.decisive_nats else f"{POLICY.decisive_nats:g} are decisive"
        left = [f" {a} and {b} would stay tied." for a, b in self.tied]
        return (
            f"{self.label[0].upper()}{self.label[1:]} would distinguish {listed(self.separates)}: {few(self.hours)} h, "
            f"{few(self.nats)} nats expected, {enough}.{''.join(left)}"
        )


@dataclass(frozen=True)
class _Option:
    """A run, with or without one more sensor, and the nats (P,) of every pair."""

    run: Run
    sensor: str | None
    pairs: Array

    @property
    def cost_h(self) -> float:
        """Hours that the machine is taken: preparation, the run, and mounting a sensor."""
        return self.run.hours + self.run.preparation.hours + (POLICY.sensor_cost_h if self.sensor else 0.0)


def next_experiment(
    alternatives: Mapping[str, Fitted],
    runs: Sequence[Run] | None = None,
    lacking_nats: Mapping[str, float] | None = None,
) -> Proposal:
    """The run for two or more alternatives by name, the likeliest first; `runs` replace the menu.

    Of the decisive runs the shortest, with its preparation, else the one that brings most of what is needed per hour.
    A pair that no run separates does not count.

    Args:
        lacking_nats: by alternative, what must be gained over the first before it is decided; default for all pairs:
            `POLICY.decisive_nats`.

    Raises:
        ValueError: fewer than two alternatives, or alternatives that show different channels.
        InputError, WorkError: a run that cannot be simulated.
    """
    if len(alternatives) < 2:
        raise ValueError(f"a next experiment separates two alternatives or more, got {len(alternatives)}")
    names, fits = list(alternatives), list(alternatives.values())
    runs = _menu(fits) if runs is None else list(runs)
    if not runs:
        return _nothing([], np.zeros(0, bool), names)
    options = _options(foreseen(fits, runs), runs)
    separable = np.max([o.pairs for o in options], axis=0) >= POLICY.negligible_nats
    if not separable.any():
        return _nothing(options, separable, names)
    needed = _needed_nats(names, lacking_nats or {})
    decisive = [o for o in options if _share_of(o, separable, needed) >= 1.0]
    if decisive:
        best = min(decisive, key=lambda o: (o.cost_h, -_least(o, separable)))
    else:
        best = max(options, key=lambda o: _share_of(o, separable, needed) / o.cost_h)
    if _least(best, separable) < POLICY.negligible_nats:  # no run does for all pairs: best for the likeliest
        separable &= np.arange(len(separable)) == int(np.argmax(separable))
        best = max(options, key=lambda o: _share_of(o, separable, needed) / o.cost_h)
    return _proposal(best, options, separable, names, fits[0])


def _needed_nats(names: Sequence[str], lacking_nats: Mapping[str, float]) -> Array:
    """The nats (P,) that separate each pair: what the second lacks against the first, else what decides a tie."""
    return np.array(
        [
            max(lacking_nats.get(second, 0.0) if first == names[0] else 0.0, POLICY.decisive_nats)
            for first, second in combinations(names, 2)
        ]
    )


def _menu(fits: Sequence[Fitted]) -> list[Run]:
    """The runs for all drivers that some alternative answers to, at the spacing of the fit's rows."""
    first = fits[0]
    drivers = dict.fromkeys(n for f in fits for n in f.problem.network.drivers)
    spacing = [m.stride * b.step_s for m, b in zip(first.problem.measured, first.batches, strict=True)]
    return menu(first.machine, first.batches, list(drivers), float(np.median(spacing)))


def _options(seen: Foreseen, runs: Sequence[Run]) -> list[_Option]:
    """Every run as it is, and with one more sensor wherever there is none."""

    def least(nats: Array) -> Array:
        """Of both orders, (P, …)."""
        return np.array([np.minimum(nats[a, b], nats[b, a]) for a, b in combinations(range(len(nats)), 2)])

    given, more = least(seen.nats), least(seen.with_sensor)
    out = [_Option(run, None, given[:, r]) for r, run in enumerate(runs)]
    out += [_Option(run, p, more[:, r, e]) for r, run in enumerate(runs) for e, p in enumerate(seen.places)]
    return out


def _least(option: _Option, separable: Array) -> float:
    return float(option.pairs[separable].min())


def _share_of(option: _Option, separable: Array, needed: Array) -> float:
    """The least share of what the pairs need."""
    return float((option.pairs / needed)[separable].min())


def _proposal(
    best: _Option, options: Sequence[_Option], separable: Array, names: Sequence[str], first: Fitted
) -> Proposal:
    pairs = list(combinations(names, 2))
    separated = {n for pair, t in zip(pairs, separable, strict=True) if t for n in pair}
    separates = tuple(n for n in names if n in separated)
    label = best.run.label + (f" with one more sensor at {best.sensor}" if best.sensor else "")
    nats = _least(best, separable)
    comments = [
        f"Distinguishes: {listed(separates)}. Expected: {few(nats)} nats in {few(best.run.hours)} h.",
        f"Begin after {_prepared(best.run)}.",
    ]
    comments += [f"Put one more temperature sensor at {best.sensor} before."] if best.sensor else []
    return Proposal(
        separates, label, best.run.hours, nats, nats / best.run.hours,
        best.run.text(_start(best.run, first), comments), best.sensor,
        tuple(p for p, t in zip(pairs, separable, strict=True) if not t), _table(options, separable, pairs),
    )  # fmt: skip


def _nothing(options: Sequence[_Option], separable: Array, names: Sequence[str]) -> Proposal:
    """No run separates any pair."""
    pairs = list(combinations(names, 2))
    table = _table(options, np.ones_like(separable), pairs)
    nats = float(table["nats"].max()) if len(table) else 0.0
    return Proposal((), "", 0.0, nats, 0.0, "", None, tuple(pairs), table)


def _prepared(run: Run) -> str:
    """The stages before a run, as a phrase."""
    return ", then ".join(
        f"{s.seconds / 3600:g} h " + (listed([f"{n} {v:g}" for n, v in s.drivers.items() if v]) or "at rest")
        for s in run.before
    )


def _start(run: Run, fit: Fitted) -> dict[str, float]:
    """Where the bodies that the machine file knows begin, to 0.1 K."""
    known = (fit.machine.twin or {}).get("bodies", fit.problem.network.bodies)
    return {name: round(degC, 1) for name, degC in begun(fit, run).items() if name in known}


def _table(options: Sequence[_Option], separable: Array, pairs: Sequence[tuple[str, str]]) -> pd.DataFrame:
    shown = [k for k, t in enumerate(separable) if t]
    rows = []
    for o in (o for o in options if not o.sensor):
        more = max(
            (m for m in options if m.sensor and m.run is o.run), key=lambda m: _least(m, separable), default=None
        )
        hardest = shown[int(np.argmin(o.pairs[shown]))]
        nats = float(o.pairs[hardest])
        rows.append(
            (o.run.label, o.run.hours, nats, nats / o.run.hours, more.sensor if more else None,
             _least(more, separable) if more else np.nan, " / ".join(pairs[hardest]))
        )  # fmt: skip
    table = pd.DataFrame(rows, columns=list(COLUMNS))
    return table.sort_values("nats", ascending=False, kind="stable", ignore_index=True)


def deciding_run(named: Sequence[Round]) -> Proposal | None:
    """For the first finding that is in doubt; None where none is, or nothing could be simulated."""
    for r in named:
        every, _, _ = explanations(r)
        if not every or every[0].probability > POLICY.clear_probability:
            continue
        alternatives: dict[str, Fitted] = {}
        for e in [
            e for e in every if e.probability >= POLICY.alternative_min_probability and e.tried.candidate.change is None
        ][: POLICY.separated_alternatives]:
            alternatives[e.tried.candidate.label] = e.tried.fitted
        if len(alternatives) >= 2:
            return _simulated(alternatives)
    return None


def revealing_run(done: Search) -> Proposal | None:
    """For the effects that gain most in the last round without being claimed, against none of them.

    None where nothing gains, no run is decisive, or nothing could be simulated.
    """
    last = done.rounds[-1]
    if last.accepted:
        return None
    alternatives, lacking_nats = {NOTHING: last.before}, {}
    for t in possible(last):
        alternatives[t.candidate.label] = t.fitted
        lacking_nats[t.candidate.label] = last.threshold - t.gain
    run = _simulated(alternatives, lacking_nats) if len(alternatives) >= 2 else None
    return run if run is not None and run.nats >= POLICY.decisive_nats else None


def possible(last: Round) -> list[Tried]:
    """The effects that a round leaves possible, the likeliest of each cluster, best first: their gain is
    decisive, and most batches do not speak against them."""
    out: dict[str, Tried] = {}
    for t in last.tried:
        if t.candidate.change is None and t.gain >= POLICY.decisive_nats and t.improved > len(t.by_run) / 2:
            out.setdefault(t.cluster, t)
    return sorted(out.values(), key=lambda t: -t.gain)[: POLICY.separated_alternatives]


def _simulated(alternatives: Mapping[str, Fitted], lacking_nats: Mapping[str, float] | None = None) -> Proposal | None:
    try:
        return next_experiment(alternatives, lacking_nats=lacking_nats)
    except (InputError, WorkError, ValueError):
        return None  # what cannot be simulated cannot be proposed
