"""Tyre options of the papers' filters: how slip stiffness depends on friction, load and axle.

Legend: K slip stiffness, F_z load, mu friction, F_0 = m*g/4 static load, k stiffness in the vehicle
file over F_0 [1].

    similarity                 K = k*F_z                        as on a real tyre
    proportional-to-friction   K = mu*k*F_z                     as in papers 000, 003 and 004
    quadratic e                K = k*F_z*(1 + e - e*F_z/F_0)    polynomial m*F_z - n*F_z^2,
                                                                (14) of paper 001
    rear_slope q               K over load of the rear tyres is q times that of the front tyres
                               (C_f and C_r of paper 002)
"""

from __future__ import annotations

from typing import Final, NamedTuple

from edge_agent.dynamics.parameters import Parameter
from schemas.errors import InputError
from schemas.runtime.records import RecordArray

STIFFNESSES: Final = {"similarity": 0.0, "proportional-to-friction": 1.0}


class TyreOption(NamedTuple):
    """Tyre model that a paper's filter assumes.

    `stiffness` selects if slip stiffness depends on friction. `quadratic` is the decrease of
    stiffness per load with the wheel load. `rear_slope` is the ratio of rear to front cornering
    stiffness per load.
    """

    stiffness: str = "similarity"  # a key of STIFFNESSES
    quadratic: float = 0.0  # see Parameter.QUADRATIC
    rear_slope: float = 1.0  # see Parameter.REAR_SLOPE


PROPORTIONAL: Final = TyreOption("proportional-to-friction")


def fit_tyres(filters: RecordArray, tyre: TyreOption) -> None:
    """Write the tyre model `tyre` that the user has chosen into the vehicle parameters of each
    filter record.

    Raises:
        InputError: the name of the stiffness is unknown, or a number is out of range.
    """
    if tyre.stiffness not in STIFFNESSES:
        choices = ", ".join(STIFFNESSES)
        raise InputError("tyre.stiffness", f"{tyre.stiffness!r} is unknown", f"choose {choices}")
    if not 0.0 <= tyre.quadratic < 1.0:
        raise InputError("tyre.quadratic", f"{tyre.quadratic} is out of range", "use 0 to 1")
    if not tyre.rear_slope > 0.0:
        raise InputError(
            "tyre.rear_slope",
            f"{tyre.rear_slope} is not positive",
            "give the ratio of the slopes, above 0",
        )
    rows = filters["row"]
    rows[:, Parameter.PROPORTIONAL] = STIFFNESSES[tyre.stiffness]
    rows[:, Parameter.QUADRATIC] = tyre.quadratic
    rows[:, Parameter.REAR_SLOPE] = tyre.rear_slope
