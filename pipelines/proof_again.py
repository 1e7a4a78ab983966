"""The run that a diagnosis proposed, done on the plant of the case, and the diagnosis with it among the recordings."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from data.errors import InputError
from twin.diagnosis.telling.findings import Findings, read_findings
from twin.proof.sealing.digests import source_digest
from twin.proof.sealing.examinee import FINDINGS
from twin.proof.sealing.examining import RUN, Examinee, examine
from twin.proof.sealing.folder import read_json


def executed(case: Path, plan: str, key: Mapping[str, Any], kept: Path, by: Examinee | None = None) -> Findings | None:
    """Findings of the case with one more recording; None where the run cannot be done or the diagnosis fails.

    What the same source answered before is read from the folder `kept`. Whoever answers sees as little as before.
    """
    source = source_digest()
    if not (kept / RUN).exists() or read_json(kept / RUN)["source_digest"] != source:
        with tempfile.TemporaryDirectory(prefix="thermodrift-") as place:
            more = Path(place) / "case"
            shutil.copytree(case, more)
            try:
                _add(more, plan, key)
            except InputError:  # a plan that this plant cannot do settles nothing
                return None
            files = examine(more, by or Examinee(rivals=None), source)
        shutil.rmtree(kept, ignore_errors=True)
        kept.mkdir()
        for name, content in files.items():
            (kept / name).write_bytes(content)
    return read_findings(kept / FINDINGS) if (kept / FINDINGS).exists() else None


def _add(case: Path, plan: str, key: Mapping[str, Any]) -> None:
    """One more recording in a case's folder, and its machine file with the sensor that the plan asked for."""
    from twin.plants.executed import execute
    from twin.plants.write import csv_text, machine_text

    drawn = key["redraw"]
    done = execute(drawn["seed"], {**drawn["effects"], **drawn["decoys"]}, plan, drawn["plant"], **drawn["options"])
    (case / "machine.yml").write_text(machine_text(done.machine), encoding="utf-8")
    text = csv_text(done.machine.machine, done.table)
    (case / "recordings" / f"{done.batch.batch_id}.csv").write_text(text, encoding="utf-8")
