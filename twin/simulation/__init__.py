"""Simulation of a network: temperatures, readings, displacements and their derivatives."""

from twin.simulation.run import TOLERANCE_K, Simulation, choose_substeps, simulate, simulation_of
from twin.simulation.start import start_of

__all__ = ["TOLERANCE_K", "Simulation", "choose_substeps", "simulate", "simulation_of", "start_of"]
