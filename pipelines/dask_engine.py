"""Engine `dask`: the grid on a Dask cluster, of this computer or of many; all other steps as with engine `prefect`.

The cut is a job of the grid: one family of one error channel, a pure function of the crossings, which travel to the
workers once. So a worker needs this program and its libraries, and neither the lake, the store nor Prefect's server;
what is finished is checkpointed here. A worker that ends loses its jobs to the others.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from functools import cache, partial
from typing import Any, Self, TypeVar

from data.endings import ending, without_interrupt
from data.errors import InputError, WorkError
from data.files import source_digest
from data.processes import Shared, one_thread
from models.selection.grid import Pool
from pipelines.caller import LANES, Done, Say
from pipelines.settings import Settings, masked
from pipelines.store.checkpoint import LIBRARIES, SOURCES, library_version

try:
    from distributed import Client, Future, LocalCluster
    from distributed.client import FutureCancelledError, FuturesCancelledError
    from distributed.scheduler import KilledWorker
except ModuleNotFoundError as missing:
    raise InputError(
        f"engine dask: package {missing.name} is not installed; run pip install 'thermodrift[dask]'"
    ) from None

TYPE_CHECKING = False
if TYPE_CHECKING:
    from pipelines.jobs.request import TrainRequest
    from pipelines.jobs.training import TrainOutcome

logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what matters reaches the user as an error
R = TypeVar("R")
LOOPBACK = "127.0.0.1"
ANSWER_S = 15.0  # for a scheduler to accept a connection
WORKERS_S = 60.0  # for the first worker to come
LOST = 3  # times that a job is sent again because all workers that held its data ended


class DaskEngine:
    """Trainings as flow runs of Prefect whose grid is computed by Dask workers.

    Args:
        address: of a scheduler, such as tcp://host:8786; None starts one on this computer, on 127.0.0.1.
        workers: worker processes of this computer; 0: one per core.
    """

    def __init__(self, address: str | None = None, workers: int = 0) -> None:
        if address is not None and "://" not in address:
            raise InputError(f"--address: got {address!r}, expected that of a Dask scheduler, such as tcp://host:8786")
        from pipelines.prefect_reports import Reports

        self._address, self._workers, self._reports = address, workers or LANES, Reports()

    def train(
        self, request: TrainRequest, settings: Settings, say: Say = lambda text: None, done: Done | None = None
    ) -> TrainOutcome:
        """See `pipelines.engine.Engine`.

        Raises:
            WorkError: the scheduler does not answer, has no worker, or its workers run another program.
        """
        from pipelines.flows import train_in_flow

        with Cluster(self._address, self._workers) as cluster:
            say(f"Dask cluster {cluster.name}: {cluster.n} workers")
            return train_in_flow(request, settings, say, done, self._reports, cluster.pools, max(LANES, cluster.n))


class Cluster:
    """A context with a client of a scheduler, which it starts and ends where `address` is None."""

    def __init__(self, address: str | None = None, workers: int = 2) -> None:
        self.name, self._address, self._workers = masked(address or LOOPBACK), address, workers
        self._local: Any = None
        self._ending = ending(self._kill)

    def __enter__(self) -> Self:
        try:
            with without_interrupt():
                if self._address is None:
                    self._local = LocalCluster(
                        n_workers=self._workers, threads_per_worker=1, processes=True, host=LOOPBACK,
                        dashboard_address=f"{LOOPBACK}:0", silence_logs=logging.CRITICAL,
                    )  # fmt: skip
                    self._ending.__enter__()
                self.client = Client(self._local or self._address, timeout=ANSWER_S, set_as_default=False)
        except (OSError, ValueError, RuntimeError) as error:  # no answer, scheme, process
            reason = masked(" ".join(str(error).split()))
            raise WorkError(f"Dask cluster {self.name}: does not answer ({reason})") from None
        try:
            self.client.wait_for_workers(1, timeout=WORKERS_S)
        except TimeoutError:
            self.__exit__()
            raise WorkError(
                f"Dask cluster {self.name}: no worker came within {WORKERS_S:g} s; start some (dask worker {self.name})"
            ) from None
        return self

    def __exit__(self, *error: Any) -> None:
        self.client.close()
        if self._local is not None:
            self._local.close()
            self._ending.__exit__(None, None, None)

    @property
    def n(self) -> int:
        """Jobs that the workers take at a time."""
        return sum(w["nthreads"] for w in self.client.scheduler_info(n_workers=-1)["workers"].values())

    def pools(self, n: int) -> tuple[Pool, Pool]:
        """The pool of all workers, and that of one of them; `n` is for the caller's computer and plays no part."""
        return ClusterPool(self), ClusterPool(self, next(iter(self.client.scheduler_info(n_workers=-1)["workers"])))

    def _kill(self) -> None:
        for nanny in list(self._local.workers.values()):
            if nanny.process is not None and nanny.process.process is not None:
                nanny.process.process.kill()


class ClusterPool:
    """Jobs on the workers of a cluster, or on one of them as long as it lives."""

    def __init__(self, cluster: Cluster, worker: str = "") -> None:
        self._cluster, self._client, self._on = cluster, cluster.client, worker

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: Any) -> None:
        pass

    def shared(self, value: Any) -> _Scattered:
        """A value that every worker of the present holds."""
        return _Scattered(self._client, value)

    def submit(self, work: Callable[..., R], *args: Any) -> Callable[[], R]:
        """Begin `work` on a worker; what is returned waits for its result, and sends it again where it was lost.

        Raises (where the result is taken):
            WorkError: the job ended several workers, the cluster is gone, or the worker runs another program.
        """
        return partial(self._result, self._sent(work, args), work, args)

    def _sent(self, work: Callable[..., R], args: tuple[Any, ...]) -> Future:
        given = [a.future if isinstance(a, _Scattered) else a for a in args]
        place = {"workers": [self._on], "allow_other_workers": True} if self._on else {}
        return self._client.submit(_alone, _program(), work, *given, pure=False, **place)

    def _result(self, job: Future, work: Callable[..., R], args: tuple[Any, ...]) -> R:
        for _ in range(LOST):
            try:
                result: R = job.result()
                return result
            except KilledWorker:
                raise WorkError(
                    f"Dask cluster {self._cluster.name}: a job ended several workers one after the other; "
                    "give them more memory"
                ) from None
            except (FutureCancelledError, FuturesCancelledError) as error:
                if self._client.status != "running":
                    raise WorkError(f"Dask cluster {self._cluster.name}: the connection is lost ({error})") from None
                for held in (a for a in args if isinstance(a, _Scattered)):
                    held.again()
                job = self._sent(work, args)
        raise WorkError(f"Dask cluster {self._cluster.name}: its workers ended {LOST} times with the data of a job")


class _Scattered:
    """A value on the workers; the ones that come later take it from those that have it."""

    def __init__(self, client: Client, value: Any) -> None:
        self._client, self._value, self._sending = client, value, threading.Lock()
        self.future = self._scatter()

    def _scatter(self) -> Future:
        return self._client.scatter([Shared(None, self._value)], broadcast=True, hash=False)[0]

    def again(self) -> None:
        """Send it again where no worker holds it any more."""
        with self._sending:
            if self.future.status != "finished":
                self.future = self._scatter()


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
