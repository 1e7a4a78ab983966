"""Real recordings on which the response of a known effect is superposed (plant C)."""

from thermodrift_exam.plants.grafted.cases import CASES, build, cases

__all__ = ["CASES", "build", "cases"]
