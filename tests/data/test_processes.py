"""The process pool: order, shared state and errors do not depend on the number of processes."""

from __future__ import annotations

import os
from functools import partial

import numpy as np
import pytest
from threadpoolctl import threadpool_info

from data.arrays import Array
from data.processes import Processes, Shared


def times(factor: Array, x: float) -> float:
    return float(factor[0] * x)


def from_shared(state: Shared[dict[str, int]], key: str) -> tuple[int, int]:
    """The value, and the identity of the state in its process."""
    return state.get()[key], id(state.get())


def refused(x: int) -> int:
    raise ValueError(f"no {x}")


def threads() -> int:
    return max((int(pool["num_threads"]) for pool in threadpool_info()), default=1)


@pytest.mark.parametrize("n", [1, 2])
def test_results_come_in_order_and_errors_where_they_are_taken(n: int) -> None:
    with Processes(n) as pool:
        assert list(pool.map(partial(times, np.array([2.0])), [3.0, 1.0, 2.0])) == [6.0, 2.0, 4.0]
        assert sorted(pool.completed(times, [(np.ones(1), 4.0), (np.ones(1), 5.0)])) == [(0, 4.0), (1, 5.0)]
        failing = pool.submit(refused, 3)
        with pytest.raises(ValueError, match="no 3"):
            failing()
        with pytest.raises(ValueError, match="no 1"):
            list(pool.map(refused, [1, 2]))


def test_a_worker_loads_shared_state_once_and_has_one_thread() -> None:
    with Processes(1, spawn=True) as pool:
        state = pool.shared({"a": 1, "b": 2})
        (a, at), (b, again) = pool.submit(from_shared, state, "a")(), pool.submit(from_shared, state, "b")()
        assert (a, b) == (1, 2) and at == again
        assert pool.submit(threads)() == 1 and pool.submit(os.getpid)() != os.getpid()


def test_without_workers_the_state_is_the_value_itself() -> None:
    with Processes() as pool:
        value = {"a": 1}
        assert pool.shared(value).get() is value and pool.submit(os.getpid)() == os.getpid()
