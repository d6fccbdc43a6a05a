"""Test that the package's normal distribution function and its logarithm equal those of SciPy, far
into both tails.
"""

from __future__ import annotations

import numpy as np
from scipy.special import log_ndtr, ndtr

from fleet_service.fusion.normal import log_distribution, normal_cdf


def test_normal_distribution_and_its_logarithm_agree_with_a_library() -> None:
    x = np.concatenate([np.linspace(-40.0, 12.0, 20_001), [-1e3, 1e3, -12.0]]).reshape(4, -1)
    np.testing.assert_allclose(normal_cdf(x), ndtr(x), rtol=1e-9, atol=1e-150)
    np.testing.assert_allclose(log_distribution(x), log_ndtr(x), rtol=1e-6, atol=1e-15)
    np.testing.assert_array_equal(log_distribution(np.array([np.inf])), [0.0])
