"""Contract suites: what a plug-in promises, as checks that its author runs on it.

Each `check_…` takes a class (or the key of a registered one) and runs named checks::

    td.testing.check_family(NearestBatch)

    @pytest.mark.parametrize("check", td.testing.check_family(NearestBatch, generate_only=True), ids=str)
    def test_contract(check):
        check()

A failure is a `ContractError` (an AssertionError) that says what was expected, what came and why it matters. The suites
need no test framework. The registered plug-ins pass the same ones.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from thermodrift.testing.contract import ContractCheck, ContractError

if TYPE_CHECKING:
    import pandas as pd

    from compensation.exports.base import Exporter
    from data.batch import Batch
    from data.checks.base import Check
    from data.readers.base import Reader
    from features.selectors.base import Selector
    from models.base import Family
    from thermodrift.testing.connectors import MakeSink, MakeSource
    from thermodrift.testing.points import Case
    from twin.mechanisms.base import Mechanism

__all__ = [
    "ContractCheck", "ContractError", "check_check", "check_export", "check_family", "check_mechanism", "check_reader",
    "check_selector", "check_sink", "check_source",
]  # fmt: skip


def check_family(family: type[Family] | str, *, generate_only: bool = False) -> Iterator[ContractCheck]:
    """Run a family on simulated runs with a known law: fit, predict, store, refuse.

    Args:
        generate_only: give the checks without running them.

    Raises:
        ContractError: checks failed; each is named.
    """
    from models.families import FAMILIES
    from thermodrift.testing.families import SUITE, FamilyCase

    return SUITE.of(FAMILIES, family, FamilyCase, generate_only)


def check_selector(selector: type[Selector] | str, *, generate_only: bool = False) -> Iterator[ContractCheck]:
    """Run a selector on stacked rows of a year: what it learns from, what must not matter, what it refuses.

    Args:
        generate_only: give the checks without running them.

    Raises:
        ContractError: checks failed; each is named.
    """
    from features.selectors import SELECTORS
    from thermodrift.testing.selectors import SUITE, SelectorCase

    return SUITE.of(SELECTORS, selector, SelectorCase, generate_only)


def check_mechanism(
    law: type[Mechanism] | str, case: Case | None = None, *, generate_only: bool = False
) -> Iterator[ContractCheck]:
    """Evaluate a mechanism at a point, over its prior and in a small machine.

    Args:
        case: its equation over quantities with units, and what else must be known; without an equation the units are
            not checked. `thermodrift.testing.points.Case`.
        generate_only: give the checks without running them.

    Raises:
        ContractError: checks failed; each is named.
    """
    from thermodrift.testing.mechanisms import SUITE, MechanismCase
    from thermodrift.testing.points import Case
    from twin.mechanisms import MECHANISMS

    return SUITE.of(MECHANISMS, law, lambda found: MechanismCase(found(), case or Case()), generate_only)


def check_check(
    check: type[Check] | str,
    fault: Callable[[Batch], Batch] | None = None,
    channel: str | None = None,
    *,
    generate_only: bool = False,
) -> Iterator[ContractCheck]:
    """Run a check for faults on clean recordings, on one with its fault, and on little.

    Args:
        fault: puts the fault into a clean recording (`thermodrift.testing.recordings.toy_batch`); None: no fault.
        channel: in which the fault is to be found; None: all channels.
        generate_only: give the checks without running them.

    Raises:
        ContractError: checks failed; each is named.
    """
    from data.checks import CHECKS
    from thermodrift.testing.checks import SUITE, CheckCase

    return SUITE.of(CHECKS, check, lambda found: CheckCase(found, fault, channel), generate_only)


def check_reader(
    reader: type[Reader] | str,
    write: Callable[[pd.DataFrame, Path], object],
    suffix: str = "",
    *,
    generate_only: bool = False,
) -> Iterator[ContractCheck]:
    """Read back what `write` has written, whole, cut and as another format.

    Args:
        write: writes a table, with its column names, to a file of the format.
        suffix: of the files, without the dot; default: the key of a registered reader.
        generate_only: give the checks without running them.

    Raises:
        ContractError: checks failed; each is named.
    """
    from data.readers import READERS
    from thermodrift.testing.readers import SUITE, ReaderCase

    key = suffix or (reader if isinstance(reader, str) else reader.__name__.removesuffix("Reader").lower())
    return SUITE.of(READERS, reader, lambda found: ReaderCase(found, key, write), generate_only, key)


def check_source(make: MakeSource, name: str = "", *, generate_only: bool = False) -> Iterator[ContractCheck]:
    """Send samples through a source of a connector.

    Args:
        make: called with a machine and samples; gives an open source at which these samples arrive.
        name: of the source in messages.
        generate_only: give the checks without running them.

    Raises:
        ContractError: checks failed; each is named.
    """
    from thermodrift.testing.connectors import SOURCE, SourceCase

    return SOURCE.checks(f"source {name or make.__name__}", lambda: SourceCase(make), generate_only)


def check_sink(make: MakeSink, name: str = "", *, generate_only: bool = False) -> Iterator[ContractCheck]:
    """Write corrections to a sink of a connector.

    Args:
        make: called with a machine; gives an open sink, and a function that gives the corrections that have arrived,
            each with the fields of `compensation.contracts.Correction`.
        name: of the sink in messages.
        generate_only: give the checks without running them.

    Raises:
        ContractError: checks failed; each is named.
    """
    from thermodrift.testing.connectors import SINK, SinkCase

    return SINK.checks(f"sink {name or make.__name__}", lambda: SinkCase(make), generate_only)


def check_export(export: type[Exporter] | str, *, generate_only: bool = False) -> Iterator[ContractCheck]:
    """Write models of several forms; what the files state, and what is refused.

    Args:
        generate_only: give the checks without running them.

    Raises:
        ContractError: checks failed; each is named.
    """
    from compensation.exports import EXPORTS
    from thermodrift.testing.exports import SUITE, ExportCase

    return SUITE.of(EXPORTS, export, ExportCase, generate_only)
