"""Every run of a folder of real recordings, for a machine file of ours on a grid of its own."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pytest

from data.batch import Batch
from data.checks import check_machine, checked
from data.machine import Machine, load_machine
from data.recording import read_batches, recording_files

ROOT = Path(__file__).parents[2]
DATA = ROOT.parent / "shared" / "data"


@cache
def recorded(name: str, folder: str, step_s: float) -> tuple[Machine, list[Batch]]:
    """Machine file on a grid of `step_s` and every run in the folder; skips without it."""
    if not (DATA / folder).is_dir():
        pytest.skip(f"no ../shared/data/{folder}")
    given = load_machine(ROOT / "machines" / f"{name}.yml")
    machine = given.model_copy(update={"recording": given.recording.model_copy(update={"step_s": step_s})})
    files, _ = recording_files(DATA / folder, machine)
    found = [b for f in files for b in read_batches(f, machine)]
    return machine, check_machine([checked(b, machine) for b in found], machine)
