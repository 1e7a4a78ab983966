"""The run that would tell tied explanations apart, asked for where the best one does not stand by itself."""

from __future__ import annotations

from collections.abc import Sequence

from data.errors import InputError, WorkError
from twin.diagnosis.next_run.next_experiment import Proposal, next_experiment
from twin.diagnosis.rounds.decision import Round
from twin.diagnosis.rounds.fitted import Fitted
from twin.diagnosis.rounds.probability import explanations
from twin.diagnosis.rounds.refits import Tried, refit
from twin.diagnosis.rounds.search import Search

CLEAR = 0.9  # above it nothing needs to be told apart
RIVAL = 0.05  # probability worth a run
MOST = 3


def settling_run(done: Search, named: Sequence[Round]) -> Proposal | None:
    """For the first finding that is in doubt; None where none is, or nothing could be simulated."""
    for r in named:
        every, _, _ = explanations(r)
        if not every or every[0].probability > CLEAR:
            continue
        rivals: dict[str, Fitted] = {}
        for e in [e for e in every if e.probability >= RIVAL and e.tried.candidate.change is None][:MOST]:
            fitted = e.tried.fitted or _refitted(r, e.tried)
            if fitted is not None:
                rivals[e.tried.candidate.words] = fitted
        if len(rivals) < 2:
            continue
        try:
            return next_experiment(rivals)
        except (InputError, WorkError, ValueError):
            return None  # what cannot be simulated cannot be proposed
    return None


def _refitted(r: Round, t: Tried) -> Fitted | None:
    done = refit(r.before, t.scored)
    return None if done is None else done.fitted
