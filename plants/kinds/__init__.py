"""Plants of other kinds than the machining centres: own engine, own formulas; every quantity is drawn from a seed."""

from plants.kinds.case import KINDS, draw_kind_case, effects_of, unlisted_of
from plants.kinds.planned import execute

__all__ = ["KINDS", "draw_kind_case", "effects_of", "execute", "unlisted_of"]
