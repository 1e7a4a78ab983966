"""Real recordings whose machine file keeps an input or an effect back that it is known to need (plant D)."""

from plants.withheld.cases import build, cases

__all__ = ["build", "cases"]
