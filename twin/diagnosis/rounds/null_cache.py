"""The structural null kept from one diagnosis to the next: by the recordings, the fit and the candidates, as arrays."""

from __future__ import annotations

import hashlib
import zipfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields
from importlib.metadata import PackageNotFoundError, version
from io import BytesIO
from pathlib import Path

import numpy as np

from data.atomic_file import write_atomic
from twin.diagnosis.rounds.fitted import Fitted
from twin.diagnosis.rounds.null import SCALES, TWINS, Null, structural_null
from twin.diagnosis.scoring.evidence import Evidence

MOST = 64  # nulls in a folder; the oldest go


def cached_null(
    folder: Path | None,
    fitted: Fitted,
    evidence: Evidence,
    counts: Mapping[str, int],
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Null:
    """`structural_null` as it was worked out before, if `folder` has it, else worked out and kept there.

    What cannot be read counts as not there; a folder that cannot be written keeps nothing.
    """
    if folder is None:
        return structural_null(fitted, evidence, counts, seed, progress)
    path = folder / f"null-{_key(fitted, evidence, counts, seed)}.npz"
    null = _read(path, tuple(counts))
    if null is None:
        null = structural_null(fitted, evidence, counts, seed, progress)
        _write(path, null)
    return null


def _key(fitted: Fitted, evidence: Evidence, counts: Mapping[str, int], seed: int) -> str:
    digest = hashlib.sha256()
    for text in _words(fitted, counts, seed):
        digest.update(f"{len(text)}:{text};".encode())
    for array in _numbers(fitted, evidence):
        digest.update(f"{array.shape}{array.dtype};".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _words(fitted: Fitted, counts: Mapping[str, int], seed: int) -> Iterator[str]:
    try:
        yield version("thermodrift")
    except PackageNotFoundError:  # run from its sources alone
        yield ""
    yield np.__version__
    yield f"{seed} {TWINS} {SCALES}"
    yield fitted.machine.machine
    yield fitted.part.model_dump_json()
    yield from (f"{name} {column}" for name, column in counts.items())


def _numbers(fitted: Fitted, evidence: Evidence) -> Iterator[np.ndarray]:
    """All that a null is made of; of the evidence's rows their sums, which tell as much."""
    inputs, state = fitted.problem.inputs, fitted.state
    yield from (inputs.time_s, inputs.n_intervals, inputs.clock_h, *inputs.drivers.values(), *inputs.recorded.values())
    yield from (fitted.values, *state.nuisance, fitted.noise.factor, fitted.memory.share, fitted.memory.keep)
    for m in fitted.problem.measured:
        yield from (m.row, m.channel, m.value)
    yield from (evidence.rows, evidence.weight, evidence.low, evidence.high)
    for b in evidence.batches:
        yield from (b.target, b.jacobian.sum(axis=0), b.columns.sum(axis=0))


def _read(path: Path, names: tuple[str, ...]) -> Null | None:
    try:
        with np.load(BytesIO(path.read_bytes()), allow_pickle=False) as kept:
            arrays = {f.name: kept[f.name] for f in fields(Null)}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
    if tuple(arrays.pop("names").tolist()) != names or arrays["gain"].ndim != 2:
        return None
    return Null(**arrays, names=names)


def _write(path: Path, null: Null) -> None:
    arrays = {f.name: np.asarray(getattr(null, f.name)) for f in fields(Null)}
    file = BytesIO()
    np.savez(file, **arrays)  # type: ignore[arg-type]
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, file.getvalue())
        kept = sorted(path.parent.glob("null-*.npz"), key=lambda p: p.stat().st_mtime, reverse=True)
        for old in kept[MOST:]:
            old.unlink(missing_ok=True)
    except OSError:  # it is worked out again next time
        return
