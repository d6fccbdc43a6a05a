"""Simulation of vehicles: single manoeuvres on a test track, and fleets on a road network. It gives
sensor readings together with the true value of every signal.
"""

from edge_agent.lab.simulation.faults import FAULTS, Fault
from edge_agent.lab.simulation.fleet import SimulatedFleet, Truth
from edge_agent.lab.simulation.manoeuvres import MANOEUVRES, jump, split
from edge_agent.lab.simulation.presets import PRESETS
from edge_agent.lab.simulation.relief import ROADS, Relief, Wave
from edge_agent.lab.simulation.scenarios import SCENARIOS, Scenario
from edge_agent.lab.simulation.sensors import SENSORS
from edge_agent.lab.simulation.simulate import DriveSetup, simulate_manoeuvre

__all__ = [
    "FAULTS",
    "MANOEUVRES",
    "PRESETS",
    "ROADS",
    "SCENARIOS",
    "SENSORS",
    "DriveSetup",
    "Fault",
    "Relief",
    "Scenario",
    "SimulatedFleet",
    "Truth",
    "Wave",
    "jump",
    "simulate_manoeuvre",
    "split",
]
