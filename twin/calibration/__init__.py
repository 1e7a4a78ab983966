"""Parameters from recordings: estimation, intervals, what the recordings do not determine, the calibrated file."""

from twin.calibration.estimate import TOLERANCE, Calibration, calibrate

__all__ = ["TOLERANCE", "Calibration", "calibrate"]
