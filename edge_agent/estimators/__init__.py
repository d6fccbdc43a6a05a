"""Estimators of vehicle motion and tyre-road friction. `create(name, vehicles)` makes a bank, the
estimators of several vehicles, by the estimator's name. All banks have one interface,
`EstimatorBank.advance`.
"""

from edge_agent.estimators.bank import EstimatorBank
from edge_agent.estimators.estimates import Estimates
from edge_agent.estimators.registry import ESTIMATORS, TUNED, create

__all__ = ["ESTIMATORS", "TUNED", "Estimates", "EstimatorBank", "create"]
