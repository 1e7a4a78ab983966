"""The result of a replay: runs that arrived one by one, the retrainings between them, and what each model was worth.

`pipelines.jobs.replay` makes it, `reports.replay` draws it. S is the residual standard deviation of a run in µm
(`models.metrics`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import cycle
from typing import Any, Literal

import numpy as np

SCHEMA = "thermodrift.replay/1"
How = Literal["as recorded", "late", "out of order", "faulty", "corrected", "again"]


@dataclass(frozen=True)
class Arrival:
    """One delivery of a run's recording.

    `how`: as recorded, late, out of order; faulty with its `fault`, later corrected; again: a copy of one that arrived
    before. `first` marks the first delivery of a run, `new` one that brings a run that can be learned.
    """

    number: int
    batch_id: str
    how: How
    fault: str = ""
    first: bool = True
    new: bool = True

    @property
    def summary(self) -> str:
        return f"{self.batch_id} {self.how}{f' ({self.fault})' if self.fault else ''}"


@dataclass(frozen=True)
class Run:
    """One run and error channel, as the models that existed when it first arrived predict it.

    Args:
        date: start of the recording, ISO; "" where it is not known.
        arrival: number of its first arrival.
        retraining: number of the last training before that.
        champion: version of the champion then, None without one.
        S_um: error with the champion; `frozen_S_um` with the first champion, `none_S_um` without a model. NaN where
            there was no champion, where it could not predict the run (`note` says why), or without a usable error.
        expected_S_um, bound90_S_um: what the champion's prediction said about this run, `flagged` why it is unlike the
            training.
    """

    target: str
    batch_id: str
    date: str
    arrival: int
    how: How
    retraining: int
    champion: int | None
    S_um: float
    frozen_S_um: float
    none_S_um: float
    expected_S_um: float
    bound90_S_um: float
    flagged: str = ""
    note: str = ""


@dataclass(frozen=True)
class Retraining:
    """One training and its promotion.

    Args:
        date: of the newest run that had arrived, ISO; "" where it is not known.
        arrival: number of the last arrival before it.
        n_batches: runs that it learned from.
        before, after: versions of the champion, None without one.
        version: what was registered, None where nothing was.
        outcome: champion, provisional, challenger, unchanged, or "not trained".
        why: the sentence of the promotion.
        expected_S_um, bound90_S_um: error of a run in the next season as the champion after it states it.
    """

    target: str
    number: int
    date: str
    arrival: int
    n_batches: int
    before: int | None
    after: int | None
    version: int | None
    outcome: str
    why: str
    expected_S_um: float
    bound90_S_um: float
    training_id: str
    seconds: float

    @property
    def promoted(self) -> bool:
        return self.after is not None and self.after != self.before


@dataclass(frozen=True)
class Paired:
    """Mean over runs of (other − champion), µm, and its standard error; positive: the champion is better."""

    n: int
    difference_um: float
    se_um: float

    @classmethod
    def of(cls, other_um: Iterable[float], champion_um: Iterable[float]) -> Paired:
        """Over the runs that both have; NaN for the standard error of fewer than two."""
        d = np.array(list(other_um), float) - np.array(list(champion_um), float)
        d = d[np.isfinite(d)]
        mean = float(d.mean()) if len(d) else math.nan
        return cls(len(d), mean, float(d.std(ddof=1) / math.sqrt(len(d))) if len(d) > 1 else math.nan)


@dataclass(frozen=True)
class Score:
    """Some runs: how many have a champion's prediction, mean S of the three on these, and the paired differences.

    `retrained` counts the runs whose champion is not the first one. `covered` of `bounded` runs stay below the bound
    of their own prediction, `covered_stated` of `bounded_stated` below the bound that the champion states for all.
    """

    n: int
    without: int
    S_um: float
    frozen_S_um: float
    none_S_um: float
    against_frozen: Paired
    against_none: Paired
    retrained: int
    covered: int
    bounded: int
    covered_stated: int
    bounded_stated: int


@dataclass(frozen=True)
class Replay:
    """A year that was replayed. `seed` None: as recorded. `left_out`: recordings that could not be read, and why."""

    machine: str
    simulated: bool
    seed: int | None
    start: int
    every: int
    effort: str
    arrivals: tuple[Arrival, ...]
    retrainings: tuple[Retraining, ...]
    runs: tuple[Run, ...]
    left_out: tuple[str, ...] = ()
    account: Mapping[str, Any] = field(default_factory=dict)  # `data.account.Account` of the recordings, as plain data

    @property
    def targets(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(r.target for r in self.retrainings))

    def runs_of(self, target: str, retraining: int | None = None) -> list[Run]:
        """Runs of an error channel in the order of arrival; with `retraining` those until the next one."""
        runs = [r for r in self.runs if r.target == target and retraining in (None, r.retraining)]
        return sorted(runs, key=lambda r: r.arrival)

    def retrainings_of(self, target: str) -> list[Retraining]:
        return [r for r in self.retrainings if r.target == target]

    def score(self, target: str, retraining: int | None = None) -> Score:
        """The runs of an error channel, all or until the next retraining, summed up."""
        stated = {r.number: r.bound90_S_um for r in self.retrainings_of(target)}
        runs = self.runs_of(target, retraining)
        judged = [r for r in runs if math.isfinite(r.S_um)]
        own = [r.S_um <= r.bound90_S_um for r in judged if math.isfinite(r.bound90_S_um)]
        general = [r.S_um <= b for r in judged if math.isfinite(b := stated.get(r.retraining, math.nan))]
        first = next((g.after for g in self.retrainings_of(target) if g.after is not None), None)
        S, frozen, none = ([getattr(r, k) for r in judged] for k in ("S_um", "frozen_S_um", "none_S_um"))
        return Score(
            len(judged), len(runs) - len(judged), _mean(S), _mean(frozen), _mean(none), Paired.of(frozen, S),
            Paired.of(none, S), sum(r.champion != first for r in judged), sum(own), len(own), sum(general),
            len(general),
        )  # fmt: skip

    def as_dict(self) -> dict[str, Any]:
        """Plain data of schema `SCHEMA`."""
        plain = asdict(self)
        scores = {
            t: {"all": asdict(self.score(t))}
            | {str(r.number): asdict(self.score(t, r.number)) for r in self.retrainings_of(t)}
            for t in self.targets
        }
        return {"schema": SCHEMA, **plain, "scores": scores}


def arrivals(batch_ids: Sequence[str], seed: int | None = None) -> tuple[Arrival, ...]:
    """The order in which runs arrive; `batch_ids` in the order of their recording.

    With a seed, about one run in seven each comes late (by up to 6 runs), after its successor, twice, or first faulty
    and corrected later (by up to 6 runs); at least one of each.
    """
    rng = np.random.default_rng(0 if seed is None else seed)
    changed = dict(zip(rng.permutation(len(batch_ids)), _changes(len(batch_ids)), strict=False))
    faults = cycle(rng.permutation(np.array(FAULTS)).tolist())
    at: list[tuple[float, Arrival]] = []
    for k, name in enumerate(batch_ids):
        how: How = "as recorded" if seed is None else changed.get(k, "as recorded")
        later = k + 0.5 + int(rng.integers(1, 7))
        if how == "late":
            at.append((later, Arrival(0, name, how)))
        elif how == "out of order":
            at.append((k + 1.25, Arrival(0, name, how)))
        elif how == "again":
            at += [(k, Arrival(0, name, "as recorded")), (later, Arrival(0, name, how, first=False, new=False))]
        elif how == "faulty":
            fault = next(faults)
            unusable = fault == "empty"
            at.append((k, Arrival(0, name, how, fault, new=not unusable)))
            at.append((later, Arrival(0, name, "corrected", first=False, new=unusable)))
        else:
            at.append((k, Arrival(0, name, how)))
    ordered = [a for _, a in sorted(at, key=lambda pair: pair[0])]
    return tuple(Arrival(**{**asdict(a), "number": n}) for n, a in enumerate(ordered, 1))


# What is wrong with a faulty delivery: no bytes; the first half alone; a temperature that keeps its value from the
# first third on; errors that are ten times too large.
FAULTS = ("empty", "cut", "stuck", "scaled")


def _changes(n: int) -> list[How]:
    each = max(1, round(n / 7))
    kinds: tuple[How, ...] = ("late", "out of order", "again", "faulty")
    return [how for _ in range(each) for how in kinds][:n]


def _mean(values: Sequence[float]) -> float:
    good = [v for v in values if math.isfinite(v)]
    return float(np.mean(good)) if good else math.nan
