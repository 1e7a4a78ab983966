"""Engines: what runs the steps of a training. The numbers are the same with each.

A new engine is a file with a class that has the methods of `Engine`, and a line in `ENGINES`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

from data.errors import InputError
from data.registry import Registry
from pipelines.caller import DirectCaller, Done, Say
from pipelines.jobs.request import TrainRequest
from pipelines.settings import Settings

if TYPE_CHECKING:
    from pipelines.jobs.training import TrainOutcome

ENGINES = Registry(
    "engine",
    {
        "prefect": "pipelines.engine:PrefectEngine",
        "direct": "pipelines.engine:DirectEngine",
        "dask": "pipelines.dask_engine:DaskEngine",
    },
)


class Engine(Protocol):
    """Made before the work begins, so that what takes time to come up can begin to."""

    def __init__(self, address: str | None = None) -> None:
        """Raises InputError where the engine cannot be used, or takes no address."""

    def train(
        self, request: TrainRequest, settings: Settings, say: Say = lambda text: None, done: Done | None = None
    ) -> TrainOutcome:
        """`pipelines.jobs.training.train`; raises what that raises."""


class DirectEngine:
    """Plain calls in this process, and worker processes where they pay."""

    def __init__(self, address: str | None = None) -> None:
        if address is not None:
            raise no_address("direct")

    def train(
        self, request: TrainRequest, settings: Settings, say: Say = lambda text: None, done: Done | None = None
    ) -> TrainOutcome:
        """See `Engine`."""
        from pipelines.jobs.training import train

        return train(request, settings, DirectCaller(done), say)


class PrefectEngine:
    """Plain calls as well, reported to the Prefect server that PREFECT_API_URL names, else to a temporary one."""

    def __init__(self, address: str | None = None) -> None:
        if address is not None:
            raise no_address("prefect")
        from pipelines.prefect_reports import Reports

        self._reports = Reports()

    def train(
        self, request: TrainRequest, settings: Settings, say: Say = lambda text: None, done: Done | None = None
    ) -> TrainOutcome:
        """See `Engine`."""
        from pipelines.flows import train_in_flow

        return train_in_flow(request, settings, say, done, self._reports)


def open_engine(key: str, address: str | None = None) -> Engine:
    """The engine of a key, ready to train.

    Raises:
        InputError: an unknown key, an engine whose packages are not installed, or one that takes no address.
    """
    made: Engine = ENGINES[key](address)
    return made


def no_address(key: str) -> InputError:
    """The error of an engine that runs on this computer alone."""
    return InputError(f"--address: engine {key} takes none; it is of the scheduler of --engine dask")
