"""Units of recordings, and their conversion factors to the units of the signal log."""

from __future__ import annotations

import math
import re
from typing import Final

from schemas.signals import CHANNELS, CONTEXT, FLAGS, per_wheel
from schemas.thresholds import GRAVITY

DEG: Final = math.pi / 180.0
# Factor to SI by unit, for each quantity; the first unit is SI itself.
ACCELERATION: Final = {"m/s^2": 1.0, "g": GRAVITY}
TURN_RATE: Final = {"rad/s": 1.0, "deg/s": DEG, "rpm": 2.0 * math.pi / 60.0}
ANGLE: Final = {"rad": 1.0, "deg": DEG}
SPEED: Final = {"m/s": 1.0, "km/h": 1.0 / 3.6, "mph": 0.44704, "kn": 1852.0 / 3600.0}
TORQUE: Final = {"N*m": 1.0, "kN*m": 1000.0}
DEGREES: Final = {"deg": 1.0, "rad": 1.0 / DEG}
FLAG: Final = {"1": 1.0}
TEMPERATURE: Final = {"degC": 1.0, "degF": 5.0 / 9.0, "K": 1.0}
SHARE: Final = {"1": 1.0, "%": 0.01}
TIME_UNITS: Final = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
# [s] Unix times of the years 2000 and 2100: a first time between them is a date.
FIRST_DATE: Final = 946_684_800.0
LAST_DATE: Final = 4_102_444_800.0
# Value of 0 degC in other units; it is subtracted before the factor is applied.
ZEROS: Final = {
    "degF": 32.0,
    "K": 273.15,
}
# Other spellings of units, in lower case without blanks -> the standard spelling.
SPELLINGS: Final = {
    "m/s2": "m/s^2",
    "m/s²": "m/s^2",
    "m/s/s": "m/s^2",
    "ms-2": "m/s^2",
    "mps2": "m/s^2",
    "m/s**2": "m/s^2",
    "unit_meterperseconsquar": "m/s^2",
    "unit_forceofgravi": "g",
    "°/s": "deg/s",
    "º/s": "deg/s",
    "dps": "deg/s",
    "degps": "deg/s",
    "degree/s": "deg/s",
    "unit_degreofarcpersecon": "deg/s",
    "radps": "rad/s",
    "1/min": "rpm",
    "°": "deg",
    "degree": "deg",
    "degrees": "deg",
    "unit_degreofarc": "deg",
    "radian": "rad",
    "radians": "rad",
    "kph": "km/h",
    "kmh": "km/h",
    "km^h": "km/h",
    "kmph": "km/h",
    "unit_kilometerperhour": "km/h",
    "mps": "m/s",
    "°c": "degC",
    "c": "degC",
    "degc": "degC",
    "celsius": "degC",
    "degreescelsius": "degC",
    "unit_degrecelsi": "degC",
    "°f": "degF",
    "f": "degF",
    "degf": "degF",
    "fahrenheit": "degF",
    "k": "K",
    "kelvin": "K",
    "percent": "%",
    "unit_percent": "%",
    "kt": "kn",
    "knot": "kn",
    "nm": "N*m",
    "n.m": "N*m",
    "n*m": "N*m",
    "unit_newtometer": "N*m",
}

QUANTITY: Final[dict[str, dict[str, float]]] = {
    "ax": ACCELERATION,
    "ay": ACCELERATION,
    "yaw_rate": TURN_RATE,
    **dict.fromkeys(per_wheel("delta"), ANGLE),
    **dict.fromkeys(per_wheel("omega"), TURN_RATE | SPEED),
    **dict.fromkeys(per_wheel("torque"), TORQUE),
    "latitude": DEGREES,
    "longitude": DEGREES,
    "yaw": ANGLE,
    **dict.fromkeys(FLAGS, FLAG),
    "air_temperature": TEMPERATURE,
    "wiper": SHARE,
}
assert set(QUANTITY) == {*CHANNELS, *CONTEXT}


def standard_spelling(text: str) -> str:
    """Return the standard spelling of a unit, given as `text`. An unknown unit is returned in lower
    case without blanks.
    """
    plain = re.sub(r"\s", "", text.lower())
    return SPELLINGS.get(plain, plain)


def unit_of_channel(channel: str, text: str) -> str | None:
    """Return the unit that a recording states for a channel in `text`, in standard spelling. Return
    None if the stated unit does not fit the channel.
    """
    unit = standard_spelling(text)
    return unit if unit in QUANTITY[channel] else None


def to_si(channel: str, unit: str, wheel_radius: float | None) -> float | None:
    """Return the factor that converts the values of a channel from the recorded `unit` to the unit
    of the signal log.

    Return None if the values are speeds at the rim and the wheel radius [m] is not known.
    """
    factor = QUANTITY[channel][unit]
    if channel.startswith("omega") and unit in SPEED:
        return None if wheel_radius is None else factor / wheel_radius
    return factor
