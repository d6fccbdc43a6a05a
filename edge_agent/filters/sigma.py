"""Sigma rules: tables of points and weights that are checked when they are created.

Legend
    n           dimension of the state
    xi          points of the rule for a standard normal variable         (points, n)
    w_mean      weights of the mean                                       (points,)
    w_cov       weights of the covariance                                 (points,)

A rule integrates the moments of the standard normal distribution exactly up to the second: sum w =
1, sum w*xi = 0, sum w*xi*xi' = I. The points of a state with mean m and sqrt_cov L are m + L*xi.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from schemas.errors import InputError
from schemas.numeric import FloatArray

EXACTNESS = 1e-9  # tolerance of the moments; with alpha = 1e-3 six of sixteen digits are lost


@dataclass(frozen=True)
class SigmaRule:
    """Points and weights of one sigma rule. The constructor checks that the rule has the right
    moments.

    Raises:
        InputError: shapes do not agree, a moment up to the second is not exact, or a covariance
            weight is negative (a square-root filter cannot use one).
    """

    name: str
    xi: FloatArray
    w_mean: FloatArray
    w_cov: FloatArray

    def __post_init__(self) -> None:
        points, n = self.xi.shape
        if self.w_mean.shape != (points,) or self.w_cov.shape != (points,):
            raise InputError(
                self.name,
                "the number of weights differs from the number of points",
                "give weights of shape (points,)",
            )
        if np.any(self.w_cov < 0.0):
            raise InputError(
                self.name,
                "a covariance weight is negative, so it has no square root",
                "raise alpha, beta or kappa",
            )
        first = self.w_mean @ self.xi
        second = (self.w_cov[:, None] * self.xi).T @ self.xi
        for moment, value, expected in (
            ("zeroth", np.sum(self.w_mean), 1.0),
            ("first", first, np.zeros(n)),
            ("second", second, np.eye(n)),
        ):
            if not np.allclose(value, expected, rtol=0.0, atol=EXACTNESS):
                raise InputError(
                    self.name,
                    f"the {moment} moment is not integrated exactly",
                    "correct the constants",
                )

    @property
    def dimension(self) -> int:
        """Return the dimension n of the states for which the rule is made."""
        return int(self.xi.shape[1])


def unscented_rule(n: int, alpha: float, beta: float, kappa: float) -> SigmaRule:
    """Return points and weights of the scaled unscented rule for n dimensions (Julier 2002). With
    lambda = alpha^2*(n + kappa) - n, the points are 0 and +-sqrt(n + lambda)*e_i (unit vectors).
    The central point has the weight w = lambda/(n + lambda) for the mean and w + 1 - alpha^2 + beta
    for the covariance; the others have 1/(2*(n + lambda)). A central point with zero weights is
    left out.
    """
    scale = alpha**2 * (n + kappa)
    if n < 1 or scale <= 0.0:
        raise InputError(
            "unscented", "n and alpha^2*(n + kappa) must be positive", "raise n, alpha or kappa"
        )
    spread = np.sqrt(scale) * np.eye(n)
    side = np.full(2 * n, 0.5 / scale)
    centre_mean = (scale - n) / scale
    centre_cov = centre_mean + 1.0 - alpha**2 + beta
    name = f"unscented({alpha:g}, {beta:g}, {kappa:g})"
    if centre_mean == 0.0 and centre_cov == 0.0:
        return SigmaRule(name, np.vstack([spread, -spread]), side, side)
    return SigmaRule(
        name,
        np.vstack([np.zeros((1, n)), spread, -spread]),
        np.concatenate([[centre_mean], side]),
        np.concatenate([[centre_cov], side]),
    )


def cubature_rule(n: int) -> SigmaRule:
    """Return points and weights of the third-degree spherical-radial rule for n dimensions
    (Arasaratnam and Haykin 2009): +-sqrt(n)*e_i with weights 1/(2n).
    """
    if n < 1:
        raise InputError("cubature", "n must be at least 1", "give the dimension of the state")
    spread = np.sqrt(float(n)) * np.eye(n)
    weight = np.full(2 * n, 0.5 / n)
    return SigmaRule("cubature", np.vstack([spread, -spread]), weight, weight)
