"""Baselines and ablations: standard methods, and the diagnosis with one rule removed, on the same fits."""

from thermodrift_rivals.evaluate import baselines, replies

__all__ = ["baselines", "replies"]
