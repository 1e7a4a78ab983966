"""Labels of plants, measures, methods and steps of the proof, and the texts of its page."""

from __future__ import annotations

import math
from collections.abc import Sequence

import pandas as pd

from evidence.proof.spec import UNSEEN
from reports.labels import NOTHING, number

# Letter, numerics, and how far the recordings are computed.
_PLANTS = {
    "elements": ("A", "finite elements", "SIMULATED"), "volumes": ("B", "finite volumes", "SIMULATED"),
    "grafted": ("C", "an effect grafted on real recordings", "partly SIMULATED"),
    "withheld": ("D", "real recordings, something kept back", "real"),
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
    "reference": "first round, full rules", "no_projection": "without projection",
    "independent_noise": "rows as independent noise", "in_sample": "in-sample score",
    "no_structural_null": "without the structural null", "no_floor_check": "without the floor check",
}  # fmt: skip
GROUPS = {"diagnosis": "Diagnosis", "baseline": "Baselines, same first fit", "ablation": "Ablations, first round only"}

NOT_SEALED = "A development suite: its seed is known, so these figures show the work's state and prove nothing."
PARTIAL = "Opened in part: some cases had no answer yet. These figures prove nothing."

METHOD = (
    "Plants A and B, and E to J of other kinds of machines, share no code with the twin and use other numerics; what "
    "they conceal, how much and where is drawn by lot from the suite's seed. Plants C and D, if there, are every case "
    "that real recordings give.",
    "Each answer key gets a salt; the hash of both and of the case's files goes into one list, and the hash of that "
    "list, the root, is published before any case is answered.",
    "Every case is answered in a process of its own that can read its machine file and its recordings and nothing "
    "else. Its answer is written before any key is opened.",
    "Opening checks every hash, then scores. A case that was run after the opening, or twice, is void: it is counted "
    "above and left out.",
    "A case counts as visible when the true effect, fitted, cuts a left-out error by a tenth or more, beyond what "
    "structure alone gives. Detection, place, mechanism and amplitude are judged on visible cases.",
)
INFORMED = "truth known"
GLOSSARY = (
    ("interval", "90 %: Clopper and Pearson for shares, bootstrap over cases for medians and quantiles."),
    ("met", "The measured value itself reaches the goal; the interval states its uncertainty."),
    (INFORMED, "The same measure for an answer that has all concealed effects in its model, refits it, and "
     "claims what passes the bars of a claim. What it misses, these recordings do not give with such bars. Of the "
     "calibration error: what probabilities show that are exactly right, in the mean over chance."),
    ("detection limit", "The size at which an effect of this kind is just found on development plants."),
    ("right answer", "Every visible effect is named with its place, and nothing false is claimed. Of a confounded pair "
     "the reported set must hold the truth; an effect that is not in the library must be called so."),
    ("decoy", "A fault of a recording or of a value in the file. Naming it is right; other claims are false."),
    ("unlisted", "Concealed is an effect that no mechanism of the library describes; right is to say so."),
    ("error", "Of left-out runs, in units of the noise: root of the mean over channels of (rms / noise)²."),
    ("with the true model", "The twin given the concealed effects and fitted: what a perfect answer would reach."),
    ("expected calibration error", "Mean distance of claimed probability and share right, weighted by cases. Right is "
     "the mechanism of a concealed effect at its place or adjacent."),
)  # fmt: skip


def meaning(term: str) -> str:
    """Its entry in the glossary."""
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
    """One word where all plants are alike, else each: ``A, B SIMULATED · D real``."""
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


def key_label(key: str) -> str:
    """A mechanism's, effect's or place's key as it is read."""
    return key.replace("_", " ")


def measured(value: float, goal: str, wanted: float) -> str:
    """A measured value in the goal's unit: a share in per cent or points where the goal says so."""
    if not math.isfinite(value):
        return NOTHING
    if "%" in goal or "point" in goal:
        scaled = 100 * value
        digits = 1 if abs(scaled) < 9.95 or 90 <= abs(scaled) < 100 else 0
        return f"{number(scaled, digits)} {'%' if '%' in goal else 'points'}"
    digits = 0 if abs(value) >= 99.5 else 1 if abs(value) >= 9.95 else 2
    return f"{number(value, digits)} s" if goal.endswith(" s") else number(value, digits)
