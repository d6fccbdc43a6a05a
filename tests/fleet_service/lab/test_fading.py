"""Tests of the ageing of the belief that a road is dry: the lower end of its friction interval
falls with time, and faster in rain and near freezing.
"""

from __future__ import annotations

import numpy as np

from fleet_service.lab import fading


def test_lower_end_falls_with_time_and_faster_in_rain_and_frost() -> None:
    lower = {
        name: fading.lower_ends(np.random.default_rng(1), known)
        for name, known in fading.WEATHER.items()
    }
    assert all((np.diff(of) <= 0.0).all() for of in lower.values())
    assert all(of[0] > 0.6 and of[-1] < 0.2 for of in lower.values())
    after_half_an_hour = {name: of[fading.AFTER_MIN.index(30)] for name, of in lower.items()}
    assert (
        after_half_an_hour["mild_dry"]
        > after_half_an_hour["unknown"]
        > after_half_an_hour["mild_rain"]
    )
    assert after_half_an_hour["mild_rain"] >= after_half_an_hour["freezing"]
