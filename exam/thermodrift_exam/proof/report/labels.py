"""Labels of plants, measures, methods and steps of the proof, and the texts of its page."""

from __future__ import annotations

import math
from collections.abc import Sequence

import pandas as pd

from reports.labels import NOTHING, number
from thermodrift_exam.proof.spec import UNSEEN

# Letter, numerics, and how far the recordings are computed.
_PLANTS = {
    "elements": ("A", "finite elements", "SIMULATED"), "volumes": ("B", "finite volumes", "SIMULATED"),
    "grafted": ("C", "an effect grafted on real recordings", "partly SIMULATED"),
    "withheld": ("D", "real recordings, a part withheld", "real"),
    "lathe": ("E", "lathe", "SIMULATED"), "board": ("F", "laboratory board", "SIMULATED"),
    "horizontal": ("G", "horizontal machining centre", "SIMULATED"), "gantry": ("H", "gantry", "SIMULATED"),
    "bench": ("I", "spindle on a bench", "SIMULATED"), "battery": ("J", "battery", "SIMULATED"),
    UNSEEN: ("unseen kinds", "not developed on", "SIMULATED"),
}  # fmt: skip
KIND_WORDS = {
    "nothing": "nothing missing", "decoy": "nothing missing, with a decoy", "one": "one effect", "two": "two effects",
    "three": "three effects", "confounded": "confounded pair", "unlisted": "effect not in the library",
    "invisible": "effect below the detection limit",
}  # fmt: skip
_METHODS = {
    "diagnosis": "the diagnosis", "raw_correlation": "largest raw correlation",
    "sparse_regression": "sparse regression on the residual", "in_sample_bic": "forward selection, in-sample BIC",
    "reference": "first round, full rules",
    "independent_noise": "rows as independent noise",
    "no_floor_check": "without the floor check",
}  # fmt: skip
GROUPS = {"diagnosis": "Diagnosis", "baseline": "Baselines, same first fit", "ablation": "Ablations, first round only"}

NOT_SEALED = "A development suite: its seed is known, so these figures show the state of the work and are no evidence."
ENDED = (
    "No case began after {until}, an end stated before the first answer; the cases are answered in their random order, "
    "and those not begun are void."
)
PARTIAL = "Opened in part: some cases have no answer yet. These figures are no evidence."

METHOD = (
    "Plants A and B, and E to J of other kinds of machines, share no code with the twin and use other numerics. The "
    "concealed effect, its size and its place are drawn at random from the seed of the suite. Plants C and D comprise "
    "every case that the real recordings provide.",
    "Each answer key gets a salt. The hashes of salted keys and case files form a list, and the hash of that list, the "
    "root, is published before any case is answered.",
    "A separate process answers each case. It can read the machine file and the recordings of its case and nothing "
    "else, and it writes its answer before any key is opened.",
    "Opening verifies every hash, then scores. A case that was answered after the opening, or twice, is void: it is "
    "counted above and not scored.",
    "A case is visible if the true model, fitted again without one of its effects, loses at least 30 nats of evidence "
    "on the recordings. Detection, place, mechanism and amplitude are scored on visible cases.",
)
INFORMED = "truth known"
GLOSSARY = (
    ("interval", "90 %: Clopper–Pearson for shares, bootstrap over cases for medians and quantiles."),
    ("met", "The measured value itself reaches the goal; the interval states its uncertainty."),
    (INFORMED, "The same measure for the true model: all concealed effects are in the model and refitted, and each is "
     "claimed if it passes the thresholds of a claim. What it misses, these recordings do not support at these "
     "thresholds. For the calibration error: the expected value for perfectly calibrated probabilities."),
    ("detection limit", "The size at which an effect of this kind is just detected on development plants."),
    ("right answer", "Every visible effect is named with its place, and no claim is false. Of a confounded pair the "
     "reported set must contain the truth; an effect that the library lacks must be reported as unlisted."),
    ("decoy", "A fault of a recording or of a value in the file. Naming it is right; other claims are false."),
    ("unlisted", "The concealed effect is described by no mechanism of the library; the right answer says so."),
    ("error", "Of left-out runs, in units of the noise: root of the mean over channels of (rms / noise)²."),
    ("with the true model", "The twin with the concealed effects, fitted: the error of a perfect answer."),
    ("expected calibration error", "Mean distance between claimed probability and share of right answers, weighted by "
     "cases. Right is the mechanism of a concealed effect at its place or adjacent."),
)  # fmt: skip


def meaning(term: str) -> str:
    """The entry of a term in the glossary."""
    return dict(GLOSSARY)[term]


def stamp(utc: str) -> str:
    """``2026-01-31 12:00 UTC``; empty where there is none."""
    return f"{pd.Timestamp(utc):%Y-%m-%d %H:%M} UTC" if utc else ""


def plant_label(plant: str) -> str:
    """``A, finite elements``; ``all plants``."""
    if plant == "all":
        return "all plants"
    return f"{_PLANTS[plant][0]}, {_PLANTS[plant][1]}" if plant in _PLANTS else plant


def plant_letter(plant: str) -> str:
    return _PLANTS[plant][0] if plant in _PLANTS else plant


def plant_origin(plant: str) -> str:
    """SIMULATED, partly SIMULATED or real."""
    return _PLANTS[plant][2] if plant in _PLANTS else ""


def origin(plants: Sequence[str]) -> str:
    """One word if all plants are alike, else each: ``A, B SIMULATED · D real``."""
    groups: dict[str, list[str]] = {}
    for p in plants:
        groups.setdefault(plant_origin(p), []).append(plant_letter(p))
    if len(groups) <= 1:
        return next(iter(groups), "")
    return " · ".join(f"{', '.join(letters)} {said}".strip() for said, letters in groups.items())


def simulated(plants: Sequence[str]) -> bool:
    """Whether all of these plants are."""
    return origin(plants) == "SIMULATED"


def method_label(method: str) -> str:
    return _METHODS.get(method, method.replace("_", " "))


def table_line(cells: Sequence[str]) -> str:
    """A row of a Markdown table."""
    return f"| {' | '.join(c.replace('|', chr(92) + '|') for c in cells)} |"


def key_label(key: str) -> str:
    """The key of a mechanism, effect or place as readable text."""
    return key.replace("_", " ")


def measured(value: float, goal: str, wanted: float) -> str:
    """A measured value in the unit of the goal: a share in per cent or points where the goal has them."""
    if not math.isfinite(value):
        return NOTHING
    if "%" in goal or "point" in goal:
        scaled = 100 * value
        digits = 1 if abs(scaled) < 9.95 or 90 <= abs(scaled) < 100 else 0
        return f"{number(scaled, digits)} {'%' if '%' in goal else 'points'}"
    digits = 0 if abs(value) >= 99.5 else 1 if abs(value) >= 9.95 else 2
    return f"{number(value, digits)} s" if goal.endswith(" s") else number(value, digits)
