"""Estimators by name, through one interface: `create(name, vehicles)` and `Bank.advance`."""

from edge_agent.estimators.friction_mixture.bank import Estimates, EstimatorBank
from edge_agent.estimators.gaussian.bank import Bank
from edge_agent.estimators.registry import ESTIMATORS, TUNED, create

__all__ = ["ESTIMATORS", "TUNED", "Bank", "Estimates", "EstimatorBank", "create"]
