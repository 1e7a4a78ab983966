"""Checkpoints of a training: finished cells are kept by content, reused after an interruption, removed once tracked."""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd

from models.crossing import Crossing, FamilyResult

Job = tuple[str, str]  # error channel, family
_SOURCES = ("data", "features", "models", "twin")


class Checkpoint:
    """Finished jobs of one training below `folder`.

    The folder's name is a digest of all that decides the numbers: rows, inputs, plan, machine file and the program's
    own source. So a changed recording, mask, option or line of code starts anew.
    """

    def __init__(self, folder: Path, crossings: Mapping[str, Crossing]) -> None:
        self._folder = folder / _digest(crossings)

    def crossed(self, cross: Callable[[Job], FamilyResult]) -> Callable[[Job], FamilyResult]:
        """`cross` with a memory: a kept job is read, a new one is written."""

        def work(job: Job) -> FamilyResult:
            held = self._folder / "__".join(job)
            if held.is_dir():
                return _read(held)
            result = cross(job)
            _write(result, held)
            return result

        return work

    def remove(self) -> None:
        """Remove the kept jobs, once they are tracked."""
        shutil.rmtree(self._folder, ignore_errors=True)


def _write(result: FamilyResult, held: Path) -> None:
    """All or nothing: a scratch folder is renamed once it is complete."""
    held.parent.mkdir(parents=True, exist_ok=True)
    scratch = Path(tempfile.mkdtemp(dir=held.parent, prefix=".writing-"))
    result.scores.to_parquet(scratch / "scores.parquet", index=False)
    result.cells.to_parquet(scratch / "cells.parquet", index=False)
    np.savez(scratch / "predictions.npz", allow_pickle=False, **result.predictions)
    (scratch / "failures.json").write_text(json.dumps(result.failures, ensure_ascii=False), encoding="utf-8")
    try:
        scratch.rename(held)
    except OSError:  # another process was quicker
        shutil.rmtree(scratch, ignore_errors=True)


def _read(held: Path) -> FamilyResult:
    with np.load(held / "predictions.npz", allow_pickle=False) as stored:
        predictions = {name: stored[name] for name in stored.files}
    failures = [(a, b) for a, b in json.loads((held / "failures.json").read_text(encoding="utf-8"))]
    scores, cells = (pd.read_parquet(held / f"{name}.parquet") for name in ("scores", "cells"))
    return FamilyResult(scores, cells, predictions, failures)


def _digest(crossings: Mapping[str, Crossing]) -> str:
    digest = hashlib.sha256(_source().encode())
    for target, crossing in sorted(crossings.items()):
        d = crossing.design
        twin = d.machine.model_dump_json() if d.machine is not None else ""
        digest.update(repr((target, crossing.plan, d.inputs, d.driver_names, d.batch_ids, twin)).encode())
        digest.update(repr([(b.digest, b.start, b.simulated) for b in crossing.batches]).encode())
        for array in (d.x, d.y_um, d.time_s, d.offsets, d.drivers):
            digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:24]


@cache
def _source() -> str:
    digest = hashlib.sha256()
    root = Path(__file__).parent.parent
    for folder in _SOURCES:
        for path in sorted((root / folder).rglob("*.py")):
            digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()
