"""A suite of small cases that nothing is drawn for: a machine of one sensor, and an answer that says it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from thermodrift_exam.proof.sealing.folder import ProofFolder
from thermodrift_exam.proof.sealing.running import Examinee
from thermodrift_exam.proof.sealing.seal import Suite, seal

HERE = str(Path(__file__).parent)
EXAMINEE = Examinee("toy_examinee:quick", "toy_examinee:rivals", import_from=(HERE,))
MACHINE = """machine: m{number}
description: '{words}'
recording: {{files: ["*.csv"], step_s: 300}}
channels:
  front: {{role: temperature, unit: degC, resolution: 0.1, range: [-20, 120]}}
  spindle_rpm: {{role: driver, unit: rpm}}
  z: {{role: error, unit: um, resolution: 1}}
"""


@dataclass(frozen=True)
class ToySpec:
    name: str
    effect: str | None
    words: str = ""


def make(spec: ToySpec, folder: Path) -> dict[str, Any]:
    """A case whose recordings are the same whatever the answer is."""
    (folder / "recordings").mkdir()
    number = spec.name.rpartition("_")[2]
    (folder / "machine.yml").write_text(MACHINE.format(number=number, words=spec.words), encoding="utf-8")
    rows = [f"{300 * k},{20 + 0.1 * k:.1f},{1000 * (k > 3)},{k}" for k in range(20)]
    (folder / "recordings" / "run_1.csv").write_text("time_s,front,spindle_rpm,z\n" + "\n".join(rows) + "\n")
    return {"case": spec.name, "kind": "one" if spec.effect else "nothing", "terms": [{"effect": spec.effect}]}


def specs(n: int, tries: Sequence[tuple[str, str]] = ()) -> list[ToySpec]:
    words = json.dumps([list(t) for t in tries])
    return [ToySpec(f"case_{k:04d}", "floor_sink" if k % 2 else None, words) for k in range(1, n + 1)]


def sealed(path: Path, n: int = 3, tries: Sequence[tuple[str, str]] = ()) -> ProofFolder:
    """A sealed proof of n such cases."""
    folder = ProofFolder(path)
    seal(folder, Suite("development", specs(n, tries), "7", secret=False), make)
    return folder
