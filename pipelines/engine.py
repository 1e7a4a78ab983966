"""What runs the steps of a training; the numbers are the same with each."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import partial
from typing import TYPE_CHECKING

from data.errors import InputError
from pipelines.caller import LANES, DirectCaller, Done, Say
from pipelines.jobs.request import TrainRequest
from pipelines.settings import Settings

if TYPE_CHECKING:
    from pipelines.dask_pools import Cluster
    from pipelines.jobs.training import TrainOutcome
    from pipelines.prefect_reports import Reports

ENGINES = ("prefect", "direct", "dask")


class Engine:
    """Made before the work begins, so that what takes time to come up can begin to.

    Args:
        key: direct: plain calls in this process, and worker processes where they pay; prefect: these, reported to the
            Prefect server that PREFECT_API_URL names, else to a temporary one; dask: reported as well, with the grid on
            a Dask cluster.
        address: of the cluster's scheduler, such as tcp://host:8786; None starts one on this computer, on 127.0.0.1.

    Raises:
        InputError: packages that are not installed, an address that is none, or one without use.
    """

    def __init__(self, key: str, address: str | None = None) -> None:
        if address is not None and key != "dask":
            raise InputError(f"--address: engine {key} takes none; it is of the scheduler of --engine dask")
        if address is not None and "://" not in address:
            raise InputError(f"--address: got {address!r}, expected that of a Dask scheduler, such as tcp://host:8786")
        self._reports: Reports | None = None
        self._cluster: Callable[[], AbstractContextManager[Cluster]] | None = None
        if key == "dask":
            from pipelines.dask_pools import open_cluster

            self._cluster = partial(open_cluster, address, LANES)
        if key != "direct":
            from pipelines.prefect_reports import Reports

            self._reports = Reports()

    def train(
        self, request: TrainRequest, settings: Settings, say: Say = lambda text: None, done: Done | None = None
    ) -> TrainOutcome:
        """`pipelines.jobs.training.train`; raises what that raises, and of a cluster that cannot be used WorkError."""
        from pipelines.flows import train_in_flow
        from pipelines.jobs.training import train

        if self._reports is None:
            return train(request, settings, DirectCaller(done), say)
        if self._cluster is None:
            return train_in_flow(request, settings, say, done, self._reports)
        with self._cluster() as cluster:
            say(f"Dask cluster {cluster.name}: {cluster.n} workers")
            return train_in_flow(request, settings, say, done, self._reports, cluster.pools, max(LANES, cluster.n))
