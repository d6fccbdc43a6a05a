"""Estimators of vehicle motion and tyre-road friction. They are selected by name and have one
interface: `create(name, vehicles)` and `EstimatorBank.advance`.
"""

from edge_agent.estimators.bank import EstimatorBank
from edge_agent.estimators.estimates import Estimates
from edge_agent.estimators.registry import ESTIMATORS, TUNED, create

__all__ = ["ESTIMATORS", "TUNED", "Estimates", "EstimatorBank", "create"]
