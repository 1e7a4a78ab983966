"""Checkpoints of a training: finished cells are kept by content, reused after an interruption, removed once tracked."""

from __future__ import annotations

import hashlib
import json
import shutil
import uuid
from collections.abc import Callable, Mapping
from datetime import datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np
import pandas as pd

from data.files import from_json, source_digest, whole_folder, write_atomic
from models.selection.crossing import Crossing, FamilyResult
from models.selection.race import Job
from pipelines.caller import Say

SOURCES = ("data", "features", "models", "twin")
LIBRARIES = ("numpy", "scipy", "scikit-learn", "torch", "pandas")  # that decide the numbers, too
_TOKEN = "token"
_SUMS = "sums.json"  # the digest of every other file of a kept job


class Checkpoint:
    """Finished jobs of one training below `folder`.

    The folder's name is a digest of all that decides the numbers: rows, inputs, plan, machine file, libraries and the
    program's own source. So a changed recording, mask, option or line of code starts anew.
    """

    def __init__(self, folder: Path, crossings: Mapping[str, Crossing]) -> None:
        self.folder = folder / _digest(crossings)

    def resume(self, say: Say = lambda text: None) -> None:
        """`say` receives how many jobs an interrupted training finished."""
        if held := self._kept():
            last = datetime.fromtimestamp(max(h.stat().st_mtime for h in held))
            say(f"resumes: {_count(len(held))} were crossed on {last:%Y-%m-%d %H:%M}")

    def crossed(
        self, cross: Callable[[Job], FamilyResult], say: Say = lambda text: None
    ) -> Callable[[Job], FamilyResult]:
        """`cross` that keeps what it returns, and returns what is kept; `say` receives what cannot be read."""

        def work(job: Job) -> FamilyResult:
            held = self.folder / job.label.replace(" ", "__")
            if held.is_dir():
                try:
                    return _read(held)
                except (OSError, ValueError, KeyError) as error:
                    say(f"{held}: is damaged ({error}); {job.label} is crossed again")
                    shutil.rmtree(held)
            result = cross(job)
            _write(result, held)
            return result

        return work

    def token(self) -> str:
        """A unique id of this training, the same after an interruption, and another one once it was removed."""
        file = self.folder / _TOKEN
        if not file.exists():
            self.folder.mkdir(parents=True, exist_ok=True)
            write_atomic(file, uuid.uuid4().hex)
        return file.read_text(encoding="utf-8")

    def summary(self) -> str:
        """How many jobs are kept where."""
        return f"{_count(len(self._kept()))} kept in {self.folder}; run the same command to go on"

    def _kept(self) -> list[Path]:
        return [p for p in self.folder.glob("[!.]*") if p.is_dir()]

    def remove(self) -> None:
        """Remove the kept jobs, once they are tracked."""
        shutil.rmtree(self.folder, ignore_errors=True)


def _count(n: int) -> str:
    return f"{n} finished part{'s' if n != 1 else ''} of the crossing"


def _write(result: FamilyResult, held: Path) -> None:
    """All or nothing."""
    try:
        with whole_folder(held) as scratch:
            result.scores.to_parquet(scratch / "scores.parquet", index=False)
            result.cells.to_parquet(scratch / "cells.parquet", index=False)
            np.savez(scratch / "predictions.npz", allow_pickle=False, **result.predictions)
            (scratch / "failures.json").write_text(json.dumps(result.failures, ensure_ascii=False), encoding="utf-8")
            (scratch / "cpu_s.json").write_text(json.dumps(result.cpu_s), encoding="utf-8")
            (scratch / _SUMS).write_text(json.dumps(_sums(scratch)), encoding="utf-8")
    except OSError:
        if not held.is_dir():  # else another process was quicker
            raise


def _read(held: Path) -> FamilyResult:
    """Raises OSError or ValueError where a file is missing or not as it was written."""
    if from_json((held / _SUMS).read_text(encoding="utf-8")) != _sums(held):
        raise ValueError("a file is not as it was written")
    with np.load(held / "predictions.npz", allow_pickle=False) as stored:
        predictions = {name: stored[name] for name in stored.files}
    failures = [(a, b) for a, b in from_json((held / "failures.json").read_text(encoding="utf-8"))]
    scores, cells = (pd.read_parquet(held / f"{name}.parquet") for name in ("scores", "cells"))
    cpu_s = float(from_json((held / "cpu_s.json").read_text(encoding="utf-8")))
    return FamilyResult(scores, cells, predictions, failures, cpu_s)


def _sums(folder: Path) -> dict[str, str]:
    return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in sorted(folder.iterdir()) if p.name != _SUMS}


def _digest(crossings: Mapping[str, Crossing]) -> str:
    digest = hashlib.sha256(f"{source_digest(*SOURCES)} {[library_version(name) for name in LIBRARIES]}".encode())
    for target, crossing in sorted(crossings.items()):
        d = crossing.design
        twin = d.machine.model_dump_json() if d.machine is not None else ""
        digest.update(repr((target, crossing.plan, d.inputs, d.driver_names, d.batch_ids, twin)).encode())
        digest.update(repr([(b.digest, b.start, b.simulated) for b in crossing.batches]).encode())
        for array in (d.x, d.y_um, d.time_s, d.offsets, d.drivers):
            digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:24]


def library_version(library: str) -> str:
    """The installed version, empty for none."""
    try:
        return version(library)
    except PackageNotFoundError:  # torch may be missing
        return ""
