"""What is left over after the search: does it follow something that no listed mechanism is?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
import pandas as pd

from data.batch import Batch
from data.errors import InputError, WorkError
from twin.calibration.identifiability import Interval
from twin.diagnosis.places.reconstruct import Reconstruction, reconstruct
from twin.diagnosis.places.where_when import Found, Located
from twin.diagnosis.proposals.candidate import Where
from twin.diagnosis.rounds.fitted import Fitted, refitted, settle
from twin.diagnosis.rounds.refits import improved
from twin.diagnosis.rounds.search import IMPROVED, Round, Search
from twin.diagnosis.rounds.trust import EVEN
from twin.diagnosis.scoring.memory import whiter
from twin.diagnosis.scoring.screen import alone
from twin.diagnosis.telling.activity import FOLLOWING, by_watts
from twin.diagnosis.telling.found import Found as Told
from twin.diagnosis.telling.found import Rms, place_words
from twin.diagnosis.telling.honest_digits import Estimate, listed
from twin.schema import TwinPart

UNLISTED_SHARE = 0.3  # of the left-out misfit that terms must explain
LEADS = 1.25  # times the gain of all listed effects: what no list has is claimed in their place only beyond it


@dataclass(frozen=True)
class Leftover:
    """An effect of no listed mechanism: its place and series, what it follows, and the network with it; `gain` in nats
    on batches left out, against `threshold`."""

    located: Located
    place: Found
    terms: Reconstruction
    gain: float
    threshold: float
    fitted: Fitted

    @property
    def flux(self) -> pd.DataFrame:
        return self.located.flux

    @property
    def name(self) -> str:
        return f"unlisted_{self.terms.place}"

    def found(
        self, part: TwinPart, intervals: Mapping[str, Interval], rms: Sequence[Rms], caps: tuple[str, ...]
    ) -> Told:
        """As a finding: the words "no listed mechanism", the regression, the watts."""
        heat = self.terms.kind == "heat"
        where = Where("node" if heat else "error", self.terms.place)
        head = f"mechanisms.{self.name}."
        stated = {n.removeprefix(head): i for n, i in intervals.items() if n.startswith(head)}
        if heat:
            regime, windows = by_watts(self.fitted, self.name, FOLLOWING)
        else:  # where the map shows it
            windows = tuple(self.located.windows(self.place))
            regime = "at times" if windows else "always"
        return Told(
            mechanism="free_flux" if heat else "free_shift",
            where=where,
            place=place_words(where, part),
            parameters={n: Estimate(i.value, i.unit, i.low, i.high) for n, i in stated.items()},
            probability=min(0.95, self.terms.improved / self.terms.batches),
            name=self.name,
            beside=f"it follows {listed([c.term.name for c in self.terms.terms])}",
            regime=regime,
            windows=windows,
            rms=tuple(rms),
            caps=caps,
            evidence={
                "gain_nats": self.gain,
                "threshold_nats": self.threshold,
                "batches_improved": self.terms.improved,
                "batches": self.terms.batches,
                "explained_share": self.terms.explained,
                "follows": self.terms.words,
            },
            size=Estimate(float(np.sqrt(np.mean(self.place.series.mean**2))), self.place.unit),
        )


def leftover(done: Search, batches: Sequence[Batch], located: Located) -> Leftover | None:
    """The strongest place where something regular is left, or None: noise, or what follows nothing known.

    `located` is of the search's final fit. What it follows must predict batches left out as well as a listed mechanism
    would have to.
    """
    now, last = done.final, done.rounds[-1]
    for place in located.found:
        if place.kind == "sensor":
            continue
        try:
            terms = reconstruct(located, batches, place, stateable=True)
        except (InputError, WorkError):
            continue
        if not terms.terms or terms.explained < UNLISTED_SHARE or terms.improved < IMPROVED * len(batches):
            continue
        stated = _stated(now, terms)
        if stated is None:
            continue
        fitted, gain, density, better = stated
        threshold = _threshold(last, terms.place, density)
        if gain > threshold and better >= IMPROVED * len(batches):
            return Leftover(located, place, terms, gain, threshold, fitted)
    return None


def instead(
    done: Search, left: Leftover | None, batches: Sequence[Batch], first: Located
) -> tuple[Search, Leftover] | None:
    """One effect of no listed mechanism in place of all that was accepted, and the search without that; None where it
    does not predict batches left out by far better, or as well as it and they together do.

    A listed mechanism may take over a part of what it is not; only the search's baseline, which `first` is of, shows it
    whole.
    """
    bare = replace(done, final=done.baseline, rounds=(replace(done.rounds[0], accepted=False),), dropped=())
    own = leftover(bare, batches, first)
    if own is None:
        return None
    both = done.final if left is None else left.fitted
    memory = reduce(whiter, (f.memory for f in (done.baseline, both, own.fitted)))
    none, them, it = (float(alone(f, memory).base_score()[0]) for f in (done.baseline, both, own.fitted))
    needed = none + LEADS * (them - none) if left is None else them - EVEN
    return (bare, own) if it > needed else None


def _threshold(last: Round, place: str, density: float) -> float:
    """What the usual listed candidate at the same place would have to gain."""
    at = [s.candidate.name for s in last.screen.scored if s.candidate.where.name == place]
    own = [last.null.threshold(density, name=n) for n in at if n in last.null.names]
    return max(float(np.median(own)) if own else last.threshold, EVEN)


def _stated(now: Fitted, terms: Reconstruction) -> tuple[Fitted, float, float, int] | None:
    """The network with the effect as a free-form mechanism, refitted: its gain, the log density of batches left out
    with it, and the batches that improve; None where no form states it."""
    if terms.part is None:
        return None
    name = f"unlisted_{terms.place}"
    part = now.part.model_copy(update={"mechanisms": {**now.part.mechanisms, name: terms.part}})
    try:
        fitted = settle(refitted(now, part))
        memory = whiter(now.memory, fitted.memory)  # as listed candidates count (`judged`)
        before, after = alone(now, memory), alone(fitted, memory)
        density = float(alone(fitted, now.memory).base_score()[0])
    except (InputError, WorkError):
        return None
    gain = float(after.base_score()[0] - before.base_score()[0])
    return fitted, gain, density, improved(before, after)
