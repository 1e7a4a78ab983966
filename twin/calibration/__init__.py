"""Calibration from recordings: estimation, intervals, identifiability, and the calibrated machine file."""

from twin.calibration.estimate import TOLERANCE, Calibration, CalibrationOptions, calibrate

__all__ = ["TOLERANCE", "Calibration", "CalibrationOptions", "calibrate"]
