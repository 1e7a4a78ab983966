"""Verdicts, probabilities and methods of a diagnosis in words."""

from __future__ import annotations

from collections.abc import Sequence

from pipelines.report.words import count, listed, number
from twin.diagnosis.telling.findings import NextExperiment
from twin.diagnosis.telling.statement import LIKELY, SURE

# Mastrandrea et al. 2010, IPCC guidance note on uncertainties, table 1: lower bound of the probability, its words.
_LIKELIHOOD = (
    (0.99, "virtually certain"), (0.95, "extremely likely"), (0.90, "very likely"), (0.66, "likely"),
    (0.50, "more likely than not"), (0.33, "about as likely as not"), (0.10, "unlikely"), (0.0, "very unlikely"),
)  # fmt: skip
NARROW = "\u202f"  # a space that does not break
CHIPS = {
    "consistent": "consistent", "explained": "explained", "partly_explained": "partly explained",
    "unlisted": "not in the library", "undecidable": "cannot tell yet",
}  # fmt: skip
_RIVALS = {
    "wrong_parameter": "a wrong parameter", "coarse_network": "too coarse a network",
    "varies_between_runs": "something that varies between runs", "free_flux": "missing heat of no listed mechanism",
    "free_shift": "missing displacement of no listed mechanism", "unlisted": "no listed mechanism",
}  # fmt: skip
UNITS = {"um": "µm", "um/m": "µm/m", "degC": "°C", "1": "", "um/K": "µm/K", "um/m/K": "µm/m/K"}

METHOD = (
    "The simulation was first given its best chance: its free parameters were recalibrated, and bodies and sensor "
    "places were refined as long as that lowered the error of runs left out of the fit.",
    "Every mechanism of the library was then tried at every place where it may act, together with sensor faults, "
    "clock shifts, wrong parameters and too coarse a network as rivals.",
    "The best were refitted in full and judged only on runs left out of the fit.",
    "A finding is accepted when its gain exceeds what structure alone gives when nothing is missing, and when most "
    "left-out runs improve.",
    "Probabilities include “nothing is missing” and “not in the library”; candidates that these "
    "recordings cannot tell apart share theirs.",
)

GLOSSARY = (
    ("left out", "Fit on the other runs, predict this one; of it only the start is estimated, within its prior."),
    ("rms", "Root mean square of recorded − simulated over a left-out run, or over the rows of all of them. "
     "Displacements count from their first sample."),
    ("before, after", "The refined and recalibrated simulation without and with what was found."),
    ("noise floor", "The rms that noise alone leaves to any simulation."),
    ("gain", "Rise of the log score (log likelihood) of the left-out runs, in nats; the threshold is what structure "
     "alone reaches when nothing is missing."),
    ("absorbed", "Share of an effect's signature that recalibrating the other parameters imitates. Near 100 %, only "
     "its prior keeps it apart."),
    ("unexplained heat, displacement, reading", "What a smooth free input at that place would have to be to close the "
     "gap, the free parameters readjusted. + : the recording has more than the simulation."),
    ("z", "Such a value by its own standard deviation."),
    ("cluster", "Candidates whose signatures agree so closely that these recordings cannot tell them apart."),
    ("detection limit", "The least effect that these recordings would have shown."),
    ("autocorrelation", "How alike the residual is to itself some time later: 0 for noise, near 1 for physics that is "
     "missing."),
    ("likelihood words", "After Mastrandrea et al. 2010: virtually certain from 99 %, extremely likely from 95 %, very "
     "likely from 90 %, likely from 66 %, more likely than not from 50 %."),
)  # fmt: skip


def likelihood(probability: float) -> str:
    """``very likely``, by the scale of the IPCC."""
    return next(words for least, words in _LIKELIHOOD if probability >= least)


def probability_words(probability: float) -> str:
    """``97 %``, never 0 or 100, and never broken over two lines."""
    percent = 100 * probability
    return ("> 99 %" if percent > 99 else "< 1 %" if percent < 1 else f"{percent:.0f} %").replace(" ", NARROW)


def headline(verdict: str, probabilities: Sequence[float]) -> str:
    """The verdict as one line for the shop floor, as certain as its surest finding; the others may be fewer."""
    n, most, least = len(probabilities), max(probabilities, default=1.0), min(probabilities, default=1.0)
    the = "The" if most >= SURE else "Most likely the" if most >= LIKELY else "Perhaps the"
    effects = "one effect" if n == 1 else f"{'up to ' if least < SURE else ''}{_spelled(n)} effects"
    return {
        "consistent": "Consistent: nothing is missing that these runs could show.",
        "explained": f"{the} simulation left out {effects}; with {'it' if n == 1 else 'them'} only the noise remains.",
        "partly_explained": f"{the} simulation left out {effects}; something else is still missing.",
        "unlisted": "Something is missing that no listed mechanism explains.",
        "undecidable": "Something is missing, but these recordings cannot tell what.",
    }[verdict]


def below_headline(verdict: str, runs: int, limits: int) -> str:
    """One sentence where a verdict has no finding to speak for it."""
    if verdict != "consistent":
        return ""
    words = f"In {count(runs, 'left-out run')} the simulation misses no more than noise and a coarse network leave"
    return words + ("; an effect above the limits below would have been seen." if limits else ".")


def where_words(kind: str, name: str) -> str:
    """``bed``, ``link bed-floor``, ``sensor z1``, ``error z``."""
    return name if kind == "node" else f"{kind} {name}"


def mechanism_words(key: str) -> str:
    """A mechanism's name for engineers, from the registry; rivals have their own."""
    from twin.mechanisms import MECHANISMS

    if key in _RIVALS:
        return _RIVALS[key]
    return MECHANISMS[key].words if key in MECHANISMS else key.replace("_", " ")


def alternative_words(others: Sequence[tuple[str, str, str, float]]) -> str:
    """``radiation at bed (2 %)`` for every (mechanism, kind, name, probability)."""
    said = [
        f"{mechanism_words(key)} at {where_words(kind, name)} ({probability_words(p)})" for key, kind, name, p in others
    ]
    return listed(said, 4)


def experiment_words(run: NextExperiment) -> str:
    """The run as a sentence, with its hours."""
    hours = "" if run.hours is None else f"; {run.hours:.3g} h in all"
    said = run.run[:1].upper() + run.run[1:].rstrip(".")
    return f"{said}{hours}."


def seconds_words(seconds: float) -> str:
    return f"{number(seconds, 0)} s" if seconds < 120 else f"{number(seconds / 60, 1)} min"


def _spelled(n: int) -> str:
    return {0: "no", 2: "two", 3: "three", 4: "four", 5: "five"}.get(n, str(n))
