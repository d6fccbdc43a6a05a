"""The estimators by name, and `create`, which makes a bank of them.

`aco-fckf`, `fckf` and `ckf` are one filter, a Rao-Blackwellised mixture: a grid of friction values
(nodes), each with a cubature filter. They differ in the fuzzy adaptation of the measurement noise
R. In `aco-fckf` it is tuned by ant colony optimisation, in `fckf` it is not tuned, and `ckf` has
none. The filter is based on paper 004. It departs from the paper in its prediction (kinematic), its
measurements (wheel speed, force from torque) and its residuals (total least squares). Friction is a
mixture instead of a state; stiffness, leaks (gravity in tilted accelerometers) and offsets are
states. The adaptation of R is bounded, and its direction is corrected (errata).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

from edge_agent.adaptation.memberships import Memberships
from edge_agent.dynamics.parameters import parameter_table
from edge_agent.estimators import (
    adaptive_federated_ckf,
    compensated_wckf,
    federated_ckf,
    paper_aco_fckf,
    sr_ukf,
)
from edge_agent.estimators.bank import EstimatorBank
from edge_agent.estimators.friction_mixture.bank import mixture_bank
from edge_agent.estimators.friction_mixture.state.calibrated import means_of, spreads_of
from edge_agent.estimators.friction_mixture.state.design import design_of
from edge_agent.estimators.friction_mixture.state.tyre_curve import Curve, check_curve
from schemas.errors import InputError
from schemas.vehicle import Vehicle

ESTIMATORS = {
    "aco-fckf": (
        "default: friction mixture of cubature filters, fuzzy noise adaptation tuned by the ant "
        "colony"
    ),
    "fckf": "the same with untuned memberships",
    "ckf": "the same without adaptation",
    "paper-aco-fckf": (
        "paper 004 as printed, errata corrected: friction as a state, fuzzy R, wheel speed as an "
        "input"
    ),
    "federated-ckf": (
        "paper 000: two cubature sub-filters and a master, for motion and for four-wheel friction"
    ),
    "adaptive-federated-ckf": (
        "paper 001: the same for motion, with fuzzy R and adaptive shares; friction is set"
    ),
    "compensated-wckf": (
        "paper 002: electric drive wheels, then motion by compensated tyre forces; friction is set"
    ),
    "sr-ukf": "paper 003: square-root unscented filter for four-wheel friction with wheel torque",
}
# Estimators whose memberships the ant colony tunes -> name of the file with these memberships
TUNED: Final = {"aco-fckf": "aco-fckf", "paper-aco-fckf": "paper-aco-fckf"}

# Estimators of the papers that have no fuzzy sets to tune
PLAIN: Final[dict[str, Callable[[Sequence[Vehicle]], EstimatorBank]]] = {
    "federated-ckf": federated_ckf.make_bank,
    "adaptive-federated-ckf": adaptive_federated_ckf.make_bank,
    "compensated-wckf": compensated_wckf.make_bank,
    "sr-ukf": sr_ukf.make_bank,
}


def create(
    name: str,
    vehicles: Sequence[Vehicle],
    *,
    memberships: Memberships | None = None,
    curve: Curve | None = None,
) -> EstimatorBank:
    """Return a bank (filters that are advanced together) of the estimator `name`, with one filter
    per vehicle.

    Args:
        name: a key of ESTIMATORS.
        vehicles: nominal vehicles, N of them.
        memberships: the fuzzy sets of the noise adaptation. Estimators in TUNED require them; in
            other estimators they replace the untuned sets.
        curve: tyre curve in place of the default one; only for `aco-fckf`, `fckf` and `ckf`.

    Raises:
        InputError: the name is unknown, no vehicle is given, tuned memberships are missing,
            memberships are given to an estimator that has none, the curve is invalid, or a curve
            is given to an estimator that uses its own tyre curve.
    """
    if name not in ESTIMATORS:
        raise InputError(
            "estimator", f"{name!r} is unknown", f"choose one of {', '.join(ESTIMATORS)}"
        )
    if not vehicles:
        raise InputError("vehicles", "none given", "give at least one vehicle")
    if curve is not None:
        if name in PLAIN or name == "paper-aco-fckf":
            raise InputError("tyre-curve", f"{name} uses its own tyre curve", "leave it out")
        try:
            check_curve(curve)
        except (ValueError, TypeError) as error:
            raise InputError(
                "tyre-curve",
                str(error),
                "give force over peak force, of slip times stiffness over peak force",
            ) from error
    if name in PLAIN:
        if memberships is not None:
            raise InputError(
                "memberships", f"{name} has no fuzzy sets to replace", "leave them out"
            )
        return PLAIN[name](vehicles)
    if memberships is None:
        if name in TUNED:
            raise InputError(
                "memberships",
                f"{name} needs tuned memberships",
                "create the estimator with estimator_factory.bank_of",
            )
        memberships = Memberships()
    if name == "paper-aco-fckf":
        return paper_aco_fckf.make_bank(vehicles, memberships)
    design = design_of(memberships, adaptive=name != "ckf", curve=curve)
    spreads = spreads_of(vehicles, design.nominal.std)
    means = means_of(vehicles, design.nominal.mean)
    return mixture_bank(parameter_table(vehicles), design, spreads, means)
