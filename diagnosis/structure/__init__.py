"""Structural discrepancy: what a lumped network leaves of a real machine, simulated and used as a covariance."""
