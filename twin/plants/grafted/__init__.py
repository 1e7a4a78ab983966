"""Real recordings on which the response of a known effect is superposed (plant C)."""

from twin.plants.grafted.cases import build, cases

__all__ = ["build", "cases"]
