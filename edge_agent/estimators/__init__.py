"""Estimators by name, through one bank: `create(name, vehicles)` and `EstimatorBank.advance`."""

from edge_agent.estimators.bank import Estimates, EstimatorBank
from edge_agent.estimators.registry import ESTIMATORS, create

__all__ = ["ESTIMATORS", "Estimates", "EstimatorBank", "create"]
