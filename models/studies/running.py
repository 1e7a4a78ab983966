"""Studies over many seeds, in several processes; what comes out does not depend on how many."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

from threadpoolctl import threadpool_limits

from data.errors import InputError
from models.studies import STUDIES
from models.studies.base import Study
from models.studies.result import StudyResult

Job = tuple[type[Study], int]


def run_studies(
    keys: Sequence[str], seeds: int, workers: int = 1, progress: Callable[[str, int, int], None] | None = None
) -> dict[str, StudyResult]:
    """Every study on seeds 0 … `seeds` − 1. `progress` is called with what was done, how many of how many.

    Raises:
        InputError: an unknown study, or fewer than 2 seeds (a spread needs two).
    """
    if seeds < 2:
        raise InputError(f"reproduce: seeds is {seeds}; expected at least 2, for a spread, and 20 for a verdict")
    jobs: list[Job] = [(STUDIES[key], seed) for key in keys for seed in range(seeds)]
    done: dict[str, list[tuple[int, dict[str, float]]]] = {key: [] for key in keys}

    def note(job: Job, figures: dict[str, float]) -> None:
        study, seed = job
        done[study.key].append((seed, figures))
        if progress:
            progress(f"{study.title}, seed {seed}", sum(map(len, done.values())), len(jobs))

    if workers > 1:
        # spawned, never forked: a fork of a process that runs threads can hang
        with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
            for job, figures in zip(jobs, pool.map(_run, jobs), strict=True):
                note(job, figures)
    else:
        for job in jobs:
            note(job, _run(job))
    return {key: StudyResult.of(STUDIES[key], runs) for key, runs in done.items()}


def _run(job: Job) -> dict[str, float]:
    study, seed = job
    with threadpool_limits(limits=1):
        return study().run(seed)
