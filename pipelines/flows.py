"""The same steps as Prefect flows: tasks with retries, a schedule, and one temporary server per command."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from prefect import flow, task
from prefect import settings as prefect_settings
from prefect.cache_policies import NO_CACHE
from prefect.server.api.server import SubprocessASGIServer
from prefect.task_runners import ThreadPoolTaskRunner
from threadpoolctl import threadpool_limits

from pipelines.settings import Settings, load
from pipelines.training import TrainOutcome, TrainRequest, train

T = TypeVar("T")
R = TypeVar("R")


class PrefectCaller:
    """Steps as tasks of the flow that is running."""

    def __init__(self, done: Callable[[str, int, int], None] | None = None) -> None:
        self.done = done

    def map(self, step: str, work: Callable[[T], R], items: Sequence[T], retries: int = 0) -> list[R]:
        # Items travel in a closure: Prefect would otherwise walk through every data frame looking for futures.
        # The lake's hashes are the cache, so Prefect keeps none.
        def one(i: int) -> R:
            return work(items[i])

        unit = task(
            one,
            name=step,
            task_run_name=f"{step} {{i}}",
            cache_policy=NO_CACHE,
            persist_result=False,
            retries=retries,
            retry_delay_seconds=2,
        )
        results: list[R] = []
        with threadpool_limits(limits=1):
            for future in [unit.submit(i) for i in range(len(items))]:
                results.append(future.result())
                if self.done:
                    self.done(step, len(results), len(items))
        return results


def start_server() -> threading.Thread | None:
    """Start Prefect's temporary server in the background, so that it comes up while other work goes on.

    None where PREFECT_API_URL names a running one. The flow finds the same server again.
    """
    if prefect_settings.PREFECT_API_URL.value():
        return None
    thread = threading.Thread(target=SubprocessASGIServer().start, kwargs={"timeout": 60}, daemon=True)
    thread.start()
    return thread


def train_in_flow(
    request: TrainRequest,
    settings: Settings,
    say: Callable[[str], None] = lambda text: None,
    done: Callable[[str, int, int], None] | None = None,
    server: threading.Thread | None = None,
) -> TrainOutcome:
    """`pipelines.training.train` as a flow; same functions, same numbers."""

    @flow(name=f"thermodrift-train-{request.machine_file.stem}", task_runner=ThreadPoolTaskRunner(max_workers=2),
          persist_result=False, validate_parameters=False)  # fmt: skip
    def training() -> TrainOutcome:
        return train(request, settings, PrefectCaller(done), say)

    if server is not None:
        server.join()
    # What goes wrong is told once, by the command, in one line.
    logging.getLogger("prefect.flow_runs").setLevel(logging.CRITICAL)
    logging.getLogger("prefect.task_runs").setLevel(logging.CRITICAL)
    return training()


@flow(
    name="thermodrift-retrain", task_runner=ThreadPoolTaskRunner(max_workers=2), persist_result=False, log_prints=True
)
def retrain(machine_file: str, recordings: list[str]) -> str:
    """Ingest what arrived since the last time and train if there is anything new; returns what was done, in words."""
    request = TrainRequest(Path(machine_file), tuple(Path(r) for r in recordings), only_if_new=True)
    outcome = train(request, load(), PrefectCaller(), print)
    if outcome.stopped:
        return outcome.stopped
    return "; ".join(p.words for p in outcome.promotions.values())


def serve_schedule(machine_file: Path, recordings: Sequence[Path], cron: str, limit: int | None = None) -> Any:
    """Serve `retrain` on a cron schedule until interrupted: recordings dropped into the folder are learned."""
    return retrain.serve(
        name=f"retrain-{machine_file.stem}",
        cron=cron,
        parameters={"machine_file": str(machine_file.resolve()), "recordings": [str(r.resolve()) for r in recordings]},
        limit=limit,
        print_starting_message=False,
    )
