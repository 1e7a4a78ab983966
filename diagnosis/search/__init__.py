"""Fits, refits and rounds: which candidates are accepted, against what chance and structure alone would gain."""
