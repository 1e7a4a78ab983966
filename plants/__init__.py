"""Simulated machines of the sample year, with numerics of their own; nothing here uses the twin."""
