"""The twin: a machine tool simulated from one file, calibrated to its recordings."""
