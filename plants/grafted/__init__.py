"""Real recordings on which the response of a known effect is superposed (plant C)."""

from plants.grafted.cases import build, cases

__all__ = ["build", "cases"]
