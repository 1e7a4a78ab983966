"""A contract as named checks with messages: what was expected, what came, why it matters."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from functools import cache, partial
from typing import Any, Generic, TypeVar

import numpy as np

from data.errors import InputError
from data.registry import Registry

S = TypeVar("S")


class ContractError(AssertionError):
    """A plug-in does not keep its contract."""


@dataclass(frozen=True)
class ContractCheck:
    """One check of one plug-in; call it to run it. `str` names it, for ``pytest.mark.parametrize(..., ids=str)``.

    Attributes:
        plugin: kind and key, such as ``family ridge``.
        name: of the check.
        why: what goes wrong where a plug-in fails it.
    """

    plugin: str
    name: str
    why: str
    run: Callable[[], None] = field(repr=False)

    def __call__(self) -> None:
        """Raises ContractError with what was expected, what came and why it matters."""
        try:
            self.run()
        except ContractError as error:
            raise ContractError(f"{self}: {error}. Why: {self.why}") from error.__cause__
        except Exception as error:
            got = f"{type(error).__name__}: {error}"
            raise ContractError(f"{self}: expected no error, got {got}. Why: {self.why}") from error

    def __str__(self) -> str:
        return f"{self.plugin}: {self.name}"


class Suite(Generic[S]):
    """The checks of one kind of plug-in, in their order. Each gets the same subject, which is made at first use."""

    def __init__(self) -> None:
        self._checks: dict[str, tuple[str, Callable[[S], None]]] = {}

    def check(self, why: str) -> Callable[[Callable[[S], None]], Callable[[S], None]]:
        """Adds a function as a check under its name."""

        def add(run: Callable[[S], None]) -> Callable[[S], None]:
            self._checks[run.__name__] = (why, run)
            return run

        return add

    def of(
        self, registry: Registry, plugin: Any, subject: Callable[[Any], S], generate_only: bool, key: str = ""
    ) -> Iterator[ContractCheck]:
        """The checks of one plug-in: a class, or the key of a registered one, which loads at the first check.

        A class is registered under its key while a check runs. Unless `generate_only` the checks have been run.

        Raises:
            ContractError: checks failed; each is named.
        """
        if isinstance(plugin, str):
            return self.checks(f"{registry.kind} {plugin}", lambda: subject(registry[plugin]), generate_only)
        key = key or getattr(plugin, "key", plugin.__name__)
        during = partial(registry.trying, key, plugin)
        return self.checks(f"{registry.kind} {key}", lambda: subject(plugin), generate_only, during)

    def checks(
        self,
        named: str,
        subject: Callable[[], S],
        generate_only: bool,
        during: Callable[[], AbstractContextManager[object]] = nullcontext,
    ) -> Iterator[ContractCheck]:
        """The checks of a subject; each runs in the context `during`. Unless `generate_only` they have been run.

        Raises:
            ContractError: checks failed; each is named.
        """
        known = cache(subject)

        def bound(check: Callable[[S], None]) -> Callable[[], None]:
            def run() -> None:
                with during():
                    check(known())

            return run

        every = [ContractCheck(named, name, why, bound(check)) for name, (why, check) in self._checks.items()]
        if not generate_only:
            run_all(every)
        return iter(every)


def run_all(checks: list[ContractCheck]) -> None:
    """Run every check; one error names all that fail.

    Raises:
        ContractError: checks failed.
    """
    failed = []
    for check in checks:
        try:
            check()
        except ContractError as error:
            failed.append(str(error))
    if failed:
        raise ContractError("\n".join([f"{len(failed)} of {len(checks)} checks failed", *failed]))


def expect(holds: object, expected: str, got: object) -> None:
    """Raises ContractError unless `holds`."""
    if not holds:
        raise ContractError(f"expected {expected}, got {got}")


def expect_described(cls: type, base: type, *texts: str) -> None:
    """Raises ContractError unless a class is a subclass of `base` with these attributes as texts that are not empty."""
    expect(issubclass(cls, base), f"a subclass of {base.__module__}.{base.__qualname__}", cls)
    for name in texts:
        text = getattr(cls, name, None)
        expect(isinstance(text, str) and text, f"a text {name}", text)


def expect_close(got: Any, want: Any, what: str, *, atol: float = 0.0, rtol: float = 0.0) -> None:
    """Raises ContractError unless two arrays agree, NaN with NaN; the message has the largest difference."""
    a, b = np.asarray(got), np.asarray(want)
    if a.shape != b.shape:
        raise ContractError(f"expected {what} of shape {b.shape}, got {a.shape}")
    if np.allclose(a, b, rtol=rtol, atol=atol, equal_nan=True):
        return
    with np.errstate(all="ignore"):
        difference = np.abs(a - b)
    worst = float(np.nanmax(difference)) if np.isfinite(difference).any() else float("nan")
    bound = f"to {atol:g}" + (f" and {rtol:g} of its size" if rtol else "")
    raise ContractError(f"expected {what} {bound}, got a difference of {worst:.3g}, or NaN on one side alone")


def expect_refused(do: Callable[[], object], *named: str, kind: type[Exception] = InputError) -> str:
    """The message of the error (`kind`) that `do` raises: one line with every text of `named`.

    Raises:
        ContractError: no error, or another one.
    """
    words = f", which names {' and '.join(named)}" if named else ""
    try:
        got = do()
    except kind as error:
        text = str(error)
        expect("\n" not in text and all(n in text for n in named), f"a {kind.__name__} of one line{words}", repr(text))
        return text
    raise ContractError(f"expected a {kind.__name__} of one line{words}, got {type(got).__name__}")
