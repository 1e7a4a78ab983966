"""Thermal tests in the style of ISO 230-3: kinds, periods, quantities."""

from twin.iso230_3.thermal import HOUR_S, ProbePair, ThermalTest, Trace, thermal_test

__all__ = ["HOUR_S", "ProbePair", "ThermalTest", "Trace", "thermal_test"]
