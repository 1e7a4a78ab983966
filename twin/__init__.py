"""Thermal network of a machine tool: simulation, calibration and views."""
