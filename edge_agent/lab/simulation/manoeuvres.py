"""The manoeuvres of a driver on a test track, as a table from the name of a manoeuvre to its
definition.

A manoeuvre is a function of the momentary state. It returns the mean road-wheel angle [rad] and the
demanded longitudinal acceleration [m/s^2]. The test track starts at the origin and runs along x.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, NamedTuple

from edge_agent.lab.simulation.motor import Pmsm, speed_demand
from schemas.thresholds import GRAVITY

WHEELBASE: Final = 2.7  # [m] value that every simulated driver assumes
SPEED_GAIN: Final = 1.5  # [1/s] demanded acceleration per error of speed
LARGEST_STEER: Final = 0.5  # [rad] at the road wheel


@dataclass(frozen=True)
class Moment:
    """State that a driver knows at an instant: time [s], pose [m, m, rad], speed [m/s], and
    demanded speed [m/s].

    The speed control of hub motors also uses `lost` [m], the integral of the speed error over time,
    and `gain` [m/s^2], the present acceleration.
    """

    t: float
    x: float
    y: float
    yaw: float
    vx: float
    speed: float
    lost: float = 0.0
    gain: float = 0.0
    motors: Pmsm | None = None


Control = Callable[[Moment], tuple[float, float]]


class TimedFriction(NamedTuple):
    """Friction that changes at a given time under all wheels at once (paper 003, section 4.2.4)."""

    before: float
    after: float
    at_s: float

    def value(self, t: float) -> float:
        """Return the friction under all wheels at time `t` [s]."""
        return self.before if t < self.at_s else self.after


Friction = float | Callable[[float, float], float] | TimedFriction
"""Friction of the track: one value everywhere; or a function of (x along the track, y to the left)
[m], evaluated at each wheel; or a value that changes at a time.
"""


@dataclass(frozen=True)
class Manoeuvre:
    """A manoeuvre, one row of the table of manoeuvres; `friction` and `speed` [m/s] are defaults
    that a caller may replace.
    """

    control: Control
    speed: float  # [m/s] initial speed; it is held unless `control` changes it
    duration: float  # [s]
    friction: Friction
    about: str


def jump(before: float, after: float, at: float) -> Callable[[float, float], float]:
    """Return a function that gives the friction along the track: `before` up to the position `at`
    [m], and `after` beyond.
    """
    return lambda x, _y: before if x < at else after


def split(left: float, right: float) -> Callable[[float, float], float]:
    """Return a function that gives the friction across the track: `left` on its left side and
    `right` on its right side.
    """
    return lambda _x, y: left if y > 0.0 else right


def hold(now: Moment, speed: float | None = None) -> float:
    """Return the acceleration [m/s^2] that brings the car back to `speed` [m/s], by default to the
    demanded speed of the manoeuvre.
    """
    error = (now.speed if speed is None else speed) - now.vx
    if now.motors is not None:
        return speed_demand(now.motors, error, now.lost if speed is None else 0.0, now.gain)
    return SPEED_GAIN * error


def steer_to(now: Moment, target_x: float, target_y: float) -> float:
    """Return the road-wheel angle [rad] of the circle through a point ahead, by pure pursuit
    (Coulter, CMU-RI-TR-92-01).
    """
    dx = target_x - now.x
    dy = target_y - now.y
    ahead = math.cos(now.yaw) * dx + math.sin(now.yaw) * dy
    left = math.cos(now.yaw) * dy - math.sin(now.yaw) * dx
    curvature = 2.0 * left / max(ahead * ahead + left * left, 1.0)
    return min(max(math.atan(WHEELBASE * curvature), -LARGEST_STEER), LARGEST_STEER)


def preview(now: Moment) -> float:
    """Return the distance [m] between the car and the point ahead to which the driver steers."""
    return max(4.0, 0.6 * now.vx)


def smooth_step(u: float) -> float:
    """Return a smooth step from 0 to 1 for paths and steering: 0 for u < 0, 1 for u > 1, and 3u² −
    2u³ between.
    """
    u = min(max(u, 0.0), 1.0)
    return u * u * (3.0 - 2.0 * u)


def lane_change_path(s: float) -> float:
    """Return the lateral position [m] of a double lane change at distance s [m]: gates similar to
    ISO 3888-1, with an offset of 3.5 m.
    """
    return 3.5 * (smooth_step((s - 20.0) / 30.0) - smooth_step((s - 75.0) / 25.0))


def double_lane_change(now: Moment) -> tuple[float, float]:
    """Return the controls (road-wheel angle, acceleration) for a change to the other lane and back
    at constant speed.
    """
    ahead = now.x + preview(now)
    return steer_to(now, ahead, lane_change_path(ahead)), hold(now)


def slalom(now: Moment) -> tuple[float, float]:
    """Return the controls (road-wheel angle, acceleration) for a slalom around cones 18 m apart."""
    ahead = now.x + preview(now)
    return steer_to(
        now, ahead, 1.2 * math.sin(math.pi * ahead / 18.0) * smooth_step(ahead / 18.0)
    ), hold(now)


def sine(now: Moment) -> tuple[float, float]:
    """Return the controls (road-wheel angle, acceleration) for sinusoidal steering at half a hertz,
    with the amplitude that gives 4 m/s^2 in a bicycle model without slip.
    """
    amplitude = min(WHEELBASE * 4.0 / now.speed**2, 0.15)
    return amplitude * math.sin(math.pi * max(now.t - 1.0, 0.0)), hold(now)


def acceleration(now: Moment) -> tuple[float, float]:
    """Return the controls (road-wheel angle, acceleration) for full throttle after one second."""
    return 0.0, 8.0 if now.t >= 1.0 else hold(now)


def braking(now: Moment) -> tuple[float, float]:
    """Return the controls (road-wheel angle, acceleration) for braking with anti-lock control after
    one second, down to walking pace.
    """
    return 0.0, _brake_after_a_second(now, -12.0)


def _brake_after_a_second(now: Moment, braking: float) -> float:
    """Return the acceleration [m/s^2] for a second at constant speed, then `braking` down to
    walking pace.
    """
    if now.t >= 1.0 and now.vx > 2.0:
        return braking
    return hold(now, now.speed if now.t < 1.0 else 1.5)


def split_braking(now: Moment) -> tuple[float, float]:
    """Return the controls (road-wheel angle, acceleration) for braking as in `braking` on a road
    with different friction left and right, while the driver steers to keep the car straight.
    """
    return steer_to(now, now.x + preview(now), 0.0), braking(now)[1]


def gentle_braking(now: Moment) -> tuple[float, float]:
    """Return the controls (road-wheel angle, acceleration) for braking with 2 m/s^2 after one
    second, down to walking pace.
    """
    return 0.0, _brake_after_a_second(now, -2.0)


def constant_radius(now: Moment) -> tuple[float, float]:
    """Return the controls (road-wheel angle, acceleration) for a circle of 40 m radius to the left
    after a straight entry (ISO 4138).
    """
    radius = 40.0
    look = preview(now)
    angle = math.atan2(now.x, radius - now.y) + look / radius
    return steer_to(now, radius * math.sin(angle), radius - radius * math.cos(angle)), hold(now)


def straight(now: Moment) -> tuple[float, float]:
    """Return the controls (road-wheel angle, acceleration) for straight driving at constant speed.
    The tyres then use almost no grip, so the drive gives no information about the road.
    """
    return steer_to(now, now.x + preview(now), 0.0), hold(now)


def j_turn(now: Moment) -> tuple[float, float]:
    """Return the controls (road-wheel angle, acceleration) for a J-turn: after one second the
    steering turns to a constant angle and holds it (ISO 7401).
    """
    return 0.06 * smooth_step((now.t - 1.0) / 0.3), hold(now)


def two_lane_changes(now: Moment) -> tuple[float, float]:
    """Return the controls (road-wheel angle, acceleration) for two double lane changes; the second
    begins at 110 m.
    """
    ahead = now.x + preview(now)
    return steer_to(now, ahead, lane_change_path(ahead) + lane_change_path(ahead - 110.0)), hold(
        now
    )


def accelerating_sine(now: Moment) -> tuple[float, float]:
    """Return the controls (road-wheel angle, acceleration) for sinusoidal steering, during which
    the speed increases by 5 m/s after six seconds.
    """
    return sine(now)[0], min(hold(now, now.speed + 5.0 * smooth_step((now.t - 6.0) / 4.0)), 2.0)


def gaining_lane_changes(now: Moment) -> tuple[float, float]:
    """Return the controls (road-wheel angle, acceleration) for lane changes during which the car
    gains 10 m/s within fifteen seconds.
    """
    return two_lane_changes(now)[0], min(
        hold(now, now.speed + 10.0 * smooth_step(now.t / 15.0)), 2.0
    )


def gaining_slalom(now: Moment) -> tuple[float, float]:
    """Return the controls (road-wheel angle, acceleration) for the slalom during which the car
    gains 7 m/s within fifteen seconds.
    """
    return slalom(now)[0], min(hold(now, now.speed + 7.0 * smooth_step(now.t / 15.0)), 2.0)


def low_turn(now: Moment) -> tuple[float, float]:
    """Return the controls (road-wheel angle, acceleration) for a turn: the steering wheel turns by
    60 degrees within .3 s and holds. The road wheels turn by one sixteenth of that angle.
    """
    return math.radians(60.0) / 16.0 * smooth_step(now.t / 0.3), hold(now)


def firm_acceleration(now: Moment) -> tuple[float, float]:
    """Return the controls (road-wheel angle, acceleration) for 0.6 g after one second, while the
    driver keeps the car straight.
    """
    return steer_to(now, now.x + preview(now), 0.0), 0.6 * GRAVITY if now.t >= 1.0 else hold(now)


def brisk_acceleration(now: Moment) -> tuple[float, float]:
    """Return the controls (road-wheel angle, acceleration) for straight acceleration with 0.45 g
    after one second.
    """
    return steer_to(now, now.x + preview(now), 0.0), 0.45 * GRAVITY if now.t >= 1.0 else hold(now)


def moderate_braking(now: Moment) -> tuple[float, float]:
    """Return the controls (road-wheel angle, acceleration) for braking with 0.28 g after one
    second, down to walking pace.
    """
    return steer_to(
        now, now.x + preview(now), 0.0
    ), -0.28 * GRAVITY if now.t >= 1.0 and now.vx > 2.0 else min(hold(now), 1.0)


def pulses(now: Moment) -> tuple[float, float]:
    """Return the controls (road-wheel angle, acceleration) that alternate two seconds of
    acceleration with two seconds of braking, while weaving slightly, as in town traffic.
    """
    acceleration = 2.5 if now.t % 4.0 < 2.0 else -2.5
    return 0.03 * math.sin(
        2.0 * now.t
    ), acceleration if 0.5 * now.speed < now.vx < 1.5 * now.speed else hold(now)


def standing(_now: Moment) -> tuple[float, float]:
    """Return the controls (road-wheel angle, acceleration) for a car at rest with the brake
    applied.
    """
    return 0.0, -3.0


def stop_and_go(now: Moment) -> tuple[float, float]:
    """Return the controls (road-wheel angle, acceleration) for stop-and-go traffic: drive straight
    for eight seconds, brake with 2.5 m/s^2 and stand for the next six, and repeat.
    """
    go = now.t % 14.0 < 8.0
    return steer_to(now, now.x + preview(now), 0.0), min(hold(now), 2.0) if go else -2.5


def street_corners(now: Moment) -> tuple[float, float]:
    """Return the controls (road-wheel angle, acceleration) for turns by 90 degrees to the left at
    street corners with a radius of 6 m, one every eight seconds.
    """
    turn = now.t % 8.0 - 3.0
    return 0.45 * (smooth_step(turn / 1.2) - smooth_step((turn - 2.6) / 1.2)), hold(now)


def parking_ramp(now: Moment) -> tuple[float, float]:
    """Return the controls (road-wheel angle, acceleration) for a circle of 8 m radius to the left
    at constant speed, as on the ramp of a parking garage, after two seconds straight on.
    """
    return math.atan(WHEELBASE / 8.0) * smooth_step((now.t - 2.0) / 2.0), hold(now)


def throttle(_now: Moment) -> tuple[float, float]:
    """Return the controls (road-wheel angle, acceleration) for 3 m/s^2 from the first sample on,
    with straight wheels: the "throttle opening of 0.3" of paper 003.
    """
    return 0.0, 3.0


def kmh(speed: float) -> float:
    """Convert a speed from km/h to m/s."""
    return speed / 3.6


MANOEUVRES: Final = {
    "double-lane-change": Manoeuvre(
        double_lane_change, kmh(80), 10.0, 0.85, "double lane change, similar to ISO 3888-1"
    ),
    "slalom": Manoeuvre(slalom, kmh(30), 15.0, 0.30, "slalom around cones 18 m apart"),
    "sine": Manoeuvre(sine, kmh(70), 12.0, 0.50, "sine steering of half a hertz"),
    "acceleration": Manoeuvre(acceleration, kmh(20), 8.0, 0.85, "full throttle in a straight line"),
    "braking": Manoeuvre(
        braking, kmh(80), 8.0, 0.85, "stop with anti-lock control, similar to ISO 21994"
    ),
    "jump-braking": Manoeuvre(
        braking, kmh(80), 8.0, jump(0.85, 0.30, 45.0), "the same stop from dry onto snow"
    ),
    "split-braking": Manoeuvre(
        split_braking, kmh(60), 8.0, split(0.80, 0.30), "stop with one side on snow, ISO 14512"
    ),
    "gentle-braking": Manoeuvre(gentle_braking, kmh(60), 10.0, 0.85, "braking with 2 m/s^2"),
    "constant-radius": Manoeuvre(
        constant_radius, kmh(40), 30.0, 0.35, "circle of 40 m radius, similar to ISO 4138"
    ),
    "straight": Manoeuvre(
        straight,
        kmh(60),
        20.0,
        0.85,
        "straight on at constant speed: no information about friction",
    ),
    "j-turn": Manoeuvre(j_turn, kmh(70), 8.0, 0.85, "step of the steering, similar to ISO 7401"),
    "two-lane-changes": Manoeuvre(
        two_lane_changes,
        kmh(30),
        25.0,
        jump(0.5, 0.3, 110.0),
        "wet, then snow: manoeuvre of paper 000",
    ),
    "accelerating-sine": Manoeuvre(
        accelerating_sine, 20.0, 13.0, 0.70, "sine, then faster: paper 002"
    ),
    "gaining-lane-changes": Manoeuvre(
        gaining_lane_changes, kmh(4), 20.0, 0.90, "lane changes, faster: paper 001"
    ),
    "gaining-slalom": Manoeuvre(gaining_slalom, kmh(4.68), 20.0, 0.90, "slalom, faster: paper 001"),
    "low-turn": Manoeuvre(low_turn, kmh(40), 8.0, 0.35, "a turn on snow: paper 003"),
    "firm-acceleration": Manoeuvre(firm_acceleration, kmh(20), 5.0, 0.85, "0.6 g: paper 003"),
    "throttle": Manoeuvre(throttle, kmh(20), 10.0, 0.85, "3 m/s^2 from the start: paper 003"),
    "brisk-acceleration": Manoeuvre(
        brisk_acceleration, kmh(20), 6.0, jump(0.85, 0.50, 30.0), "0.45 g onto wet"
    ),
    "moderate-braking": Manoeuvre(
        moderate_braking, kmh(80), 6.0, jump(0.85, 0.30, 60.0), "0.28 g from dry onto snow"
    ),
    "standing": Manoeuvre(
        standing, 0.0, 60.0, 0.85, "standing with the brake applied: level or on a slope"
    ),
    "stop-and-go": Manoeuvre(
        stop_and_go, kmh(40), 56.0, 0.85, "traffic lights: stop, wait, start again"
    ),
    "street-corners": Manoeuvre(
        street_corners, 5.0, 24.0, 0.85, "turns by 90 degrees with a radius of 6 m"
    ),
    "parking-ramp": Manoeuvre(
        parking_ramp, 3.5, 40.0, 0.85, "circle of 8 m radius, as in a parking garage"
    ),
    "pulses": Manoeuvre(pulses, kmh(50), 30.0, 0.60, "throttle and brakes in turn while weaving"),
}
