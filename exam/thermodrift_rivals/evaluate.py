"""All baselines and ablations evaluated on one diagnosis, with the seconds that each took."""

from __future__ import annotations

from time import perf_counter
from typing import Any

from threadpoolctl import threadpool_limits

from data.errors import WorkError
from data.registry import Registry
from diagnosis.result import Diagnosis
from diagnosis.search.search import Search
from thermodrift_rivals.ablations import Stage

BASELINES = Registry(
    "baseline",
    {
        "raw_correlation": "thermodrift_rivals.regression:raw_correlation",
        "sparse_regression": "thermodrift_rivals.regression:sparse_regression",
        "in_sample_bic": "thermodrift_rivals.bic:in_sample_bic",
    },
)
ABLATIONS = Registry(
    "ablation",
    {
        "reference": "thermodrift_rivals.ablations:reference",
        "independent_noise": "thermodrift_rivals.ablations:independent_noise",
        "no_floor_check": "thermodrift_rivals.ablations:no_floor_check",
    },
)


@threadpool_limits.wrap(limits=1)
def baselines(done: Diagnosis | Search) -> dict[str, Any]:
    """The replies of the baselines alone, which take a second; ablations refit and take as long as a diagnosis.

    Raises:
        WorkError: a diagnosis that kept no search.
    """
    search = _search_of(done)
    return {"baselines": {key: _timed(BASELINES[key], search) for key in BASELINES}}


@threadpool_limits.wrap(limits=1)
def replies(done: Diagnosis | Search) -> dict[str, Any]:
    """The reply of each to the same recordings, as stored in `rivals.json`.

    Baselines start from the first fit; ablations and the reference, the full rules, are of the first round. With a
    diagnosis, the reference can say that something is unlisted.

    Raises:
        WorkError: a diagnosis that kept no search.
    """
    stage = Stage(_search_of(done), done.findings if isinstance(done, Diagnosis) else None)
    return {
        **baselines(done),
        "ablations": {key: _timed(ABLATIONS[key], stage) for key in ABLATIONS if key != "reference"},
        "reference": _timed(ABLATIONS["reference"], stage),
    }


def _search_of(done: Diagnosis | Search) -> Search:
    search = done.search if isinstance(done, Diagnosis) else done
    if search is None or not search.rounds:
        raise WorkError("baselines: the diagnosis kept no search; hand over one that `diagnose` has just made")
    return search


def _timed(method: Any, given: Any) -> dict[str, Any]:
    begun = perf_counter()
    reply = method(given)
    out: dict[str, Any] = reply.as_json(perf_counter() - begun)
    return out
