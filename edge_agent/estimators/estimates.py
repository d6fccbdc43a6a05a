"""Output of an estimator bank (estimators of several vehicles): an array with a named column per
estimated quantity. Compiled functions write this array.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from schemas.numeric import BoolArray, FloatArray

FlagArray: TypeAlias = NDArray[np.int64]


class Column(IntEnum):
    """Index of the column of an estimated quantity in the output of a sample. No column is ever
    NaN.
    """

    VX = 0  # [m/s]
    VY = 1  # [m/s]
    YAW_RATE = 2  # [rad/s]
    SIDESLIP = 3  # [rad]
    VX_STD = 4
    VY_STD = 5
    YAW_RATE_STD = 6
    SIDESLIP_STD = 7
    MU = 8  # [1] median
    MU_LOWER = 9  # [1] 5 % quantile
    MU_UPPER = 10  # [1] 95 % quantile
    MU_UTILISED = 11  # [1] largest grip used by any wheel in the last second
    INNOVATION_NIS = 12  # normalised squared innovation, mean over the measurements; 1 is expected
    ADAPTATION = 13  # [1] largest factor on R
    INNOVATION_LOG_LIKELIHOOD = 14  # [nat] of the sample's measurements, 0 without measurements
    HEALTH = 15  # schemas.signals.Health
    P_SLIPPERY = 16  # P(mu < SLIPPERY_MU)
    WHEELS = 17  # median, lower and upper end of each wheel, if the estimator has them


COLUMNS = tuple(column.name.lower() for column in Column if column < Column.WHEELS)
# Number of columns of an estimator with one friction, and with one per wheel
ONE_FRICTION = int(Column.WHEELS)
FOUR_FRICTIONS = int(Column.WHEELS) + 12


class _View:
    """Descriptor that returns one column of the output of all samples, as a view of the array.

    The view is created only when the column is read, which saves time in a live loop that reads few
    columns.
    """

    def __init__(self, place: Column) -> None:
        self._place = int(place)

    def __get__(self, estimates: Estimates, owner: type) -> FloatArray:
        return estimates.values[..., self._place]


def _view_column(place: Column) -> Any:  # noqa: ANN401 each attribute is annotated with its type
    return _View(place)


class Estimates:
    """Output of an estimator bank for T samples of N vehicles. Each column is an array of shape (T,
    N), documented in `Column`.
    """

    __slots__ = ("evidence", "jumps", "values")

    vx: FloatArray = _view_column(Column.VX)
    vy: FloatArray = _view_column(Column.VY)
    yaw_rate: FloatArray = _view_column(Column.YAW_RATE)
    sideslip: FloatArray = _view_column(Column.SIDESLIP)
    vx_std: FloatArray = _view_column(Column.VX_STD)
    vy_std: FloatArray = _view_column(Column.VY_STD)
    yaw_rate_std: FloatArray = _view_column(Column.YAW_RATE_STD)
    sideslip_std: FloatArray = _view_column(Column.SIDESLIP_STD)
    mu: FloatArray = _view_column(Column.MU)
    mu_lower: FloatArray = _view_column(Column.MU_LOWER)
    mu_upper: FloatArray = _view_column(Column.MU_UPPER)
    mu_utilised: FloatArray = _view_column(Column.MU_UTILISED)
    innovation_nis: FloatArray = _view_column(Column.INNOVATION_NIS)
    adaptation: FloatArray = _view_column(Column.ADAPTATION)
    innovation_log_likelihood: FloatArray = _view_column(Column.INNOVATION_LOG_LIKELIHOOD)
    p_slippery: FloatArray = _view_column(Column.P_SLIPPERY)

    def __init__(
        self, values: FloatArray, evidence: FloatArray | None = None, jumps: BoolArray | None = None
    ) -> None:
        self.values = values  # (T, N, ONE_FRICTION or FOUR_FRICTIONS) indexed by Column
        # (T, N, 32) log-likelihood on the friction grid, NaN at most samples. At the end of a visit
        # it is that of the visit's last part, at a friction jump that of the part that ends.
        self.evidence = evidence
        self.jumps = jumps  # (T, N) True where the friction jumped within a visit

    @property
    def health(self) -> FlagArray:
        """Return the health flags (`schemas.signals.Health`) of each sample and vehicle, (T, N)."""
        return self.values[..., Column.HEALTH].astype(np.int64)

    @property
    def mu_wheel(self) -> FloatArray | None:
        """Return median, lower and upper end of the friction interval of each wheel, (T, N, 4, 3).
        Return None if the estimator has only one friction for all wheels.
        """
        if self.values.shape[-1] == ONE_FRICTION:
            return None
        return self.values[..., Column.WHEELS :].reshape(*self.values.shape[:-1], 4, 3)
