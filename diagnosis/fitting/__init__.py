"""Fits of a twin part to batches: generalised least squares with the memory that the fit itself leaves."""
