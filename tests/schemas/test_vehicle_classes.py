"""Tests of the vehicle files of common classes: each class is a plausible car, and an unknown class
is refused.
"""

from __future__ import annotations

import math

import pytest

from schemas.errors import InputError
from schemas.thresholds import GRAVITY
from schemas.vehicle import load_vehicle
from schemas.vehicle_classes import CLASSES


@pytest.mark.parametrize("name", CLASSES)
def test_class_is_a_plausible_car_that_understeers(name: str) -> None:
    car = load_vehicle(f"class:{name}")
    wheelbase = car.cg_to_front_axle + car.cg_to_rear_axle
    assert 0.43 < math.sqrt(car.yaw_inertia / car.mass) / wheelbase < 0.5
    understeer = car.understeer_per_g()
    assert understeer is not None
    assert 0.015 < understeer < 0.04
    assert 10.0 < car.longitudinal_stiffness / (0.25 * car.mass * GRAVITY) < 30.0
    assert 0.2 < car.cg_height / car.track_front < 0.5


def test_unknown_class_is_refused_with_the_list() -> None:
    with pytest.raises(InputError, match="sports-car"):
        load_vehicle("class:tank")
