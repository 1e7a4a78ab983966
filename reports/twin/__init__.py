"""Reports of a twin: network picture, calibration, simulated runs, thermal tests."""
