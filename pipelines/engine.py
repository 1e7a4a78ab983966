"""What runs the steps of a training; the numbers are the same with each."""

from __future__ import annotations

from typing import TYPE_CHECKING

from data.errors import InputError
from pipelines.caller import LANES, DirectCaller, Done, Say
from pipelines.jobs.request import TrainRequest
from pipelines.settings import Settings

if TYPE_CHECKING:
    from pipelines.jobs.training import TrainOutcome

ENGINES = ("prefect", "direct", "dask")


def train_by(
    engine: str,
    request: TrainRequest,
    settings: Settings,
    say: Say = lambda text: None,
    done: Done | None = None,
    address: str | None = None,
) -> TrainOutcome:
    """`pipelines.jobs.training.train` by one of `ENGINES`.

    Args:
        engine: direct: plain calls in this process, and worker processes where they pay; prefect: these, reported to
            the Prefect server that PREFECT_API_URL names, else to a temporary one; dask: reported as well, with the
            grid on a Dask cluster.
        address: of the cluster's scheduler, such as tcp://host:8786; None starts one on this computer, on 127.0.0.1.

    Raises:
        InputError: packages that are not installed, an address that is none, or one without use.
        WorkError: a cluster that cannot be used.
    """
    if address is not None and engine != "dask":
        raise InputError(f"--address: engine {engine} takes none; it is of the scheduler of --engine dask")
    if address is not None and "://" not in address:
        raise InputError(f"--address: got {address!r}, expected that of a Dask scheduler, such as tcp://host:8786")
    if engine == "direct":
        from pipelines.jobs.training import train

        return train(request, settings, DirectCaller(done), say)
    if engine == "dask":
        from pipelines.dask_pools import open_cluster
    from pipelines.prefect_reports import Reports

    reports = Reports()  # comes up while the rest is imported
    from pipelines.flows import train_in_flow

    if engine == "prefect":
        return train_in_flow(request, settings, say, done, reports)
    with open_cluster(address, LANES) as cluster:
        say(f"Dask cluster {cluster.name}: {cluster.n} workers")
        return train_in_flow(request, settings, say, done, reports, cluster.pools, max(LANES, cluster.n))
