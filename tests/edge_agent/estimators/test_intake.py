"""Tests of two inputs of the papers' filters that are computed from samples. They are the largest
grip used in the last second, and the cosines of the present and previous steering angles.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from edge_agent.estimators.common.excitation import SLOT_S
from edge_agent.estimators.common.inputs import SampleUse, take_sample_in
from edge_agent.estimators.common.run import PaperMemory, new_filters
from edge_agent.lab.simulation.presets import PRESETS
from schemas.signals import CHANNELS, S
from schemas.thresholds import GRAVITY, UTILISED_WINDOW_S

CAR = PRESETS["sedan"].vehicle


@pytest.mark.parametrize("every_s", [0.004, 0.01, 0.05, 0.3])
def test_the_grip_used_is_the_largest_of_the_slots_of_the_last_second(every_s: float) -> None:
    (memory,) = new_filters(PaperMemory, [CAR])
    rng = np.random.default_rng(5)
    slots = [(-math.inf, 0.0)]
    for k in range(600):
        sample = np.zeros(len(CHANNELS))
        time = -1.0 + k * every_s
        sample[S.AY] = 8.0 * rng.random() ** 3 * (0.2 if k > 300 else 1.0)
        _, kind, _ = take_sample_in(memory["track"], memory["row"], time, sample)
        assert kind == (SampleUse.BEGUN if k == 0 else SampleUse.STEPPED)
        used = sample[S.AY] / GRAVITY
        if time - slots[-1][0] < SLOT_S:
            slots[-1] = (slots[-1][0], max(slots[-1][1], used))
        else:
            slots.append((time, used))
        expected = max(grip for began, grip in slots if began > time - UTILISED_WINDOW_S)
        assert memory["track"]["excitation"]["largest"] == pytest.approx(expected, rel=1e-12)


def test_the_cosines_are_those_of_the_angles_in_use_now_and_before() -> None:
    (memory,) = new_filters(PaperMemory, [CAR])
    track = memory["track"]
    for k, angle in enumerate((0.1, 0.1, math.nan, -0.3, 9.0, 0.0)):
        sample = np.zeros(len(CHANNELS))
        sample[S.DELTA] = angle
        take_sample_in(track, memory["row"], 0.01 * k + (1.0 if k > 4 else 0.0), sample)
        for turned, inputs in (
            (track["steering"], track["inputs"]),
            (track["steering_before"], track["inputs_before"]),
        ):
            delta = inputs[S.DELTA : S.DELTA + 4]
            assert turned == pytest.approx(np.stack([np.cos(delta), np.sin(delta)]), abs=1e-15)
    assert track["inputs"][S.DELTA] == 0.0
