"""Plants of other kinds than the machining centre, with an engine and formulas of their own, drawn from a seed."""

from thermodrift_exam.plants.kinds.case import KINDS, draw_kind_case, effects_of, unlisted_of
from thermodrift_exam.plants.kinds.planned import execute

__all__ = ["KINDS", "draw_kind_case", "effects_of", "execute", "unlisted_of"]
