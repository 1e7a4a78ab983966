"""Baselines and ablations: standard methods, and the diagnosis with one rule removed, on the same fits."""

from evidence.baselines.evaluate import replies

__all__ = ["replies"]
