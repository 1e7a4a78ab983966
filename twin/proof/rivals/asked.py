"""All rivals asked about one diagnosis, with the seconds that each took."""

from __future__ import annotations

from time import perf_counter
from typing import Any

from threadpoolctl import threadpool_limits

from data.errors import WorkError
from twin.diagnosis.diagnosis import Diagnosis
from twin.diagnosis.rounds.search import Search
from twin.proof.rivals.registry import ABLATIONS, BASELINES
from twin.proof.rivals.stage import Stage


@threadpool_limits.wrap(limits=1)
def rivals(done: Diagnosis | Search) -> dict[str, Any]:
    """What each would have answered to the same recordings, as `rivals.json` keeps it.

    Baselines start from the first fit, before anything was refined; ablations and the reference, the full rules, are of
    the round that first decided about physics. With a diagnosis, the reference can say that something is unlisted.

    Raises:
        WorkError: a diagnosis that kept no search.
    """
    search = done.search if isinstance(done, Diagnosis) else done
    if search is None or not search.rounds:
        raise WorkError("rivals: the diagnosis kept no search; hand over one that `diagnose` has just made")
    stage = Stage(search, done.findings if isinstance(done, Diagnosis) else None)
    return {
        "baselines": {key: _timed(BASELINES[key], search) for key in BASELINES},
        "ablations": {key: _timed(ABLATIONS[key], stage) for key in ABLATIONS if key != "reference"},
        "reference": _timed(ABLATIONS["reference"], stage),
    }


def _timed(method: Any, given: Any) -> dict[str, Any]:
    begun = perf_counter()
    reply = method(given)
    out: dict[str, Any] = reply.as_json(perf_counter() - begun)
    return out
