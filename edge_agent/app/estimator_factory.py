"""Creation of estimator banks (estimators of N vehicles, advanced together) by name. The
memberships (fuzzy sets) of these estimators are those stored in this package, or those that the
caller gives. Estimators of other installed packages are included.
"""

from __future__ import annotations

from collections.abc import Sequence

from edge_agent.adaptation.memberships import Memberships
from edge_agent.app.tuned_memberships import shipped_memberships
from edge_agent.estimators import ESTIMATORS, TUNED, EstimatorBank, create
from schemas.errors import InputError
from schemas.runtime import plugins
from schemas.vehicle import Vehicle


def known_estimators() -> dict[str, str]:
    """Return a dictionary from the name of each estimator to a one-line description. Estimators of
    other installed packages are included.
    """
    plugin_estimators = {
        name: f"from {point.value}"
        for name, point in plugins.entry_points_of(plugins.ESTIMATORS).items()
    }
    return plugin_estimators | ESTIMATORS


def bank_of(
    estimator: str, vehicles: Sequence[Vehicle], memberships: Memberships | None = None
) -> EstimatorBank:
    """Return a bank of estimators (advanced together), one per vehicle.

    Args:
        estimator: a key of `known_estimators()`; NAME@CURVE is the estimator NAME with the tyre
            curve CURVE of another installed package.
        vehicles: nominal vehicles, N of them.
        memberships: fuzzy sets that replace those in this package.

    Raises:
        InputError: the estimator or the tyre curve is unknown, no vehicle is given, memberships are
            given for an estimator that has none, or the tuned memberships cannot be read.
    """
    estimator, _, own = estimator.partition("@")
    if own and own not in plugins.entry_points_of(plugins.TYRE_CURVES):
        curve_names = ", ".join(plugins.entry_points_of(plugins.TYRE_CURVES)) or "none is installed"
        raise InputError("tyre-curve", f"{own!r} is unknown", f"choose one of {curve_names}")
    curve = plugins.load_entry_point(plugins.TYRE_CURVES, own) if own else None
    if estimator not in ESTIMATORS and estimator in plugins.entry_points_of(plugins.ESTIMATORS):
        if memberships is not None:
            raise InputError(
                "memberships", f"{estimator} has no fuzzy sets to replace", "leave them out"
            )
        bank: EstimatorBank = plugins.load_entry_point(plugins.ESTIMATORS, estimator)(vehicles)
        return bank
    if estimator not in ESTIMATORS:
        raise InputError(
            "estimator",
            f"{estimator!r} is unknown",
            f"choose one of {', '.join(known_estimators())}",
        )
    if memberships is None and estimator in TUNED:
        memberships = shipped_memberships(TUNED[estimator])
    return create(estimator, vehicles, memberships=memberships, curve=curve)
