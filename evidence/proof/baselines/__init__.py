"""Rivals of the diagnosis on the same fits: plain methods, and the diagnosis with one of its rules taken out."""

from evidence.proof.baselines.evaluate import rivals

__all__ = ["rivals"]
