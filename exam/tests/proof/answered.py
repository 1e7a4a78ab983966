"""Hand-made answer keys and findings, as a vault and a diagnosis would write them."""

from __future__ import annotations

from typing import Any

from diagnosis.findings.schema import Findings
from thermodrift_exam.proof.scoring.answer_key import Stored
from thermodrift_exam.proof.scoring.true_model import TrueModel

LENGTH_S = {"r1": 1000.0, "r2": 3000.0}
BODY_OF = {"t_bed": "bed", "t_column": "column"}


def term(effect: str = "cabinet_heat", **changes: Any) -> dict[str, Any]:
    """By default 100 W of a cabinet into the column, beside the head and the bed, always on."""
    return {
        "effect": effect, "mechanism": effect, "where": {"kind": "node", "name": "column"}, "also": [],
        "neighbours": ["head", "bed"], "parameters": {"heat": {"value": 100.0, "unit": "W"}}, "words": "", "size": 1.0,
        "limit_share": 4.0, "decoy": False, "active": "always", "driver": None, "same_as": [], **changes,
    }  # fmt: skip


def answer(
    kind: str = "one", *terms: dict[str, Any], case: str = "case_0001", plant: str = "volumes"
) -> dict[str, Any]:
    return {
        "schema": "thermodrift.proof_answer/1", "case": case, "kind": kind, "plant": plant, "suite": "development",
        "simulated": True, "words": "", "machine": "m", "seed": 1, "terms": list(terms), "idle_channels": [],
        "options": {}, "redraw": {},
    }  # fmt: skip


def finding(
    mechanism: str = "cabinet_heat", name: str = "column", kind: str = "node", **changes: Any
) -> dict[str, Any]:
    """By default 110 W (90 to 130), 95 % sure."""
    return {
        "mechanism": mechanism, "where": {"kind": kind, "name": name}, "probability": 0.95, "statement": "said",
        "parameters": {"heat": {"value": 110.0, "unit": "W", "interval90": [90.0, 130.0]}}, **changes,
    }  # fmt: skip


def other(mechanism: str, name: str, probability: float, kind: str = "node") -> dict[str, Any]:
    return {"mechanism": mechanism, "where": {"kind": kind, "name": name}, "probability": probability}


def findings(verdict: str, *found: dict[str, Any], **changes: Any) -> Findings:
    """Errors of two channels: 3 and 4 times the noise before, 1 and 1 after."""
    rms = {
        "before": {"z_um": 3.0, "t_K": 0.4},
        "after": {"z_um": 1.0, "t_K": 0.1},
        "noise_floor": {"z_um": 1.0, "t_K": 0.1},
    }
    if not found:
        rms["after"] = rms["before"]
    return Findings.from_json(
        {
            "schema": "thermodrift.findings/1", "machine": "m", "batches": ["r1", "r2"], "verdict": verdict,
            "findings": list(found), "fit": {"left_out_rms": rms, "batches_improved": 2, "batches": 2},
            "seconds": 20.0, **changes,
        }
    )  # fmt: skip


def stored(verdict: str = "explained", *found: dict[str, Any], **changes: Any) -> Stored:
    given = {"run": {"seconds": 20.0, "error": None}, "length_s": LENGTH_S, "body_of": BODY_OF, **changes}
    return Stored(findings(verdict, *found), **given)


def truth(*visible: bool, error_true: float = 1.0) -> TrueModel:
    n = len(visible)
    return TrueModel(3.5, error_true, 1.0, (50.0,) * n, (40.0,) * n, visible, ((80.0, 60.0, 110.0),) * n)
