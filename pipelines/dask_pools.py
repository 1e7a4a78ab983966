"""The grid on a Dask cluster, of this computer or of many.

A job is one family of one error channel, a pure function of the crossings, which travel to the workers once. So a
worker needs this program and its libraries, and neither the lake, the store nor Prefect's server. A worker that ends
loses its jobs to the others; Dask makes the crossings again where none of them is left.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any, TypeVar

from data.endings import ending, without_interrupt
from data.errors import InputError, WorkError, masked
from data.files import source_digest
from data.processes import Shared, one_thread
from models.selection.grid import Pool
from pipelines.store.checkpoint import LIBRARIES, SOURCES, library_version

try:
    import dask
    from distributed import Client, Future, LocalCluster
    from distributed.client import FutureCancelledError, FuturesCancelledError
    from distributed.scheduler import KilledWorker
except ModuleNotFoundError as missing:
    raise InputError(
        f"engine dask: package {missing.name} is not installed; run pip install 'thermodrift[dask]'"
    ) from None

logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what matters reaches the user as an error
dask.config.set({"distributed.admin.large-graph-warning-threshold": "1 TB"})  # crossings are sent once
R = TypeVar("R")
LOOPBACK = "127.0.0.1"
ANSWER_S = 15.0  # for a scheduler to accept a connection
WORKERS_S = 60.0  # for the first worker to come


@contextmanager
def open_cluster(address: str | None, workers: int) -> Iterator[Cluster]:
    """The cluster of a scheduler, or one of so many worker processes of this computer that ends with the context.

    Raises:
        WorkError: the scheduler does not answer, or has no worker.
    """
    name = masked(address or LOOPBACK)
    with ExitStack() as opened:
        try:
            with without_interrupt():
                local = None if address else opened.enter_context(_local(workers))
                client = opened.enter_context(Client(address or local, timeout=ANSWER_S, set_as_default=False))
        except (OSError, ValueError, RuntimeError) as error:  # no answer, scheme, process
            reason = masked(" ".join(str(error).split()))
            raise WorkError(f"Dask cluster {name}: does not answer ({reason})") from None
        try:
            client.wait_for_workers(1, timeout=WORKERS_S)
        except TimeoutError:
            raise WorkError(
                f"Dask cluster {name}: no worker came within {WORKERS_S:g} s; start some (dask worker {name})"
            ) from None
        yield Cluster(name, client)


@contextmanager
def _local(workers: int) -> Iterator[LocalCluster]:
    with LocalCluster(
        n_workers=workers, threads_per_worker=1, processes=True, host=LOOPBACK, dashboard_address=f"{LOOPBACK}:0",
        silence_logs=logging.CRITICAL,
    ) as cluster, ending(partial(_kill, cluster)):  # fmt: skip
        yield cluster


def _kill(cluster: LocalCluster) -> None:
    for nanny in list(cluster.workers.values()):
        if nanny.process is not None and nanny.process.process is not None:
            nanny.process.process.kill()


@dataclass(frozen=True)
class Cluster:
    """A pool of the workers of a scheduler, or of one of them as long as it lives; see `models.selection.grid.Pool`."""

    name: str
    client: Client
    worker: str = ""

    @property
    def n(self) -> int:
        """Jobs that the workers take at a time."""
        return sum(w["nthreads"] for w in self._workers().values())

    def pools(self, n: int) -> tuple[Pool, Pool]:
        """The pool of all workers, and that of one of them; `n` is for the caller's computer and plays no part."""
        return self, replace(self, worker=next(iter(self._workers())))

    def __enter__(self) -> None:
        pass

    def __exit__(self, *error: Any) -> None:
        pass

    def shared(self, value: Any) -> Future:
        """A value on every worker. As the result of a task it is made again where all workers that held it ended."""
        held = self.client.submit(Shared, None, value, pure=False)
        self.client.replicate([held])
        return held

    def submit(self, work: Callable[..., R], *args: Any) -> Callable[[], R]:
        """Begin `work` on a worker; what is returned waits for its result.

        Raises (where the result is taken):
            WorkError: the job ended several workers, the cluster is gone, or the worker runs another program.
        """
        place = {"workers": [self.worker], "allow_other_workers": True} if self.worker else {}
        return partial(self._result, self.client.submit(_alone, _program(), work, *args, pure=False, **place))

    def _result(self, job: Future) -> Any:
        try:
            return job.result()
        except KilledWorker:
            raise WorkError(
                f"Dask cluster {self.name}: a job ended several workers one after the other; give them more memory"
            ) from None
        except (FutureCancelledError, FuturesCancelledError) as error:
            raise WorkError(f"Dask cluster {self.name}: the connection is lost ({error})") from None

    def _workers(self) -> dict[str, Any]:
        found: dict[str, Any] = self.client.scheduler_info(n_workers=-1)["workers"]
        return found


@cache
def _program() -> dict[str, str]:
    """What decides the numbers besides the data."""
    return {"thermodrift": source_digest(*SOURCES), **{n: library_version(n).partition("+")[0] for n in LIBRARIES}}


def _alone(program: dict[str, str], work: Callable[..., R], *args: Any) -> R:
    """On a worker: a job with one thread of linear algebra, of the program that sent it."""
    other = [name for name, expected in program.items() if _program()[name] != expected]
    if other:
        raise WorkError(f"a Dask worker has another version of {', '.join(other)}; install the same on all computers")
    one_thread()
    return work(*args)
