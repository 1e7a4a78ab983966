"""Refits and rounds: which candidates are claimed, and how probable each explanation is."""
