"""Estimator banks as the commands make them: by name, with the memberships that come with the package."""

from __future__ import annotations

from collections.abc import Sequence

from edge_agent.app.tuned_memberships import shipped
from edge_agent.estimators import TUNED, EstimatorBank, create
from schemas.vehicle import Vehicle


def bank_of(estimator: str, vehicles: Sequence[Vehicle]) -> EstimatorBank:
    """A bank of estimators by name, one per vehicle.

    Raises:
        InputError: no such estimator, no vehicle, or its tuned memberships cannot be read.
    """
    return create(estimator, vehicles, memberships=shipped(TUNED[estimator]) if estimator in TUNED else None)
