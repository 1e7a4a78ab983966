"""Baselines and ablations: plain methods, and the diagnosis with one of its rules taken out, on the same fits."""

from evidence.proof.baselines.evaluate import replies

__all__ = ["replies"]
