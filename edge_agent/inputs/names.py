"""Draft of a profile (assignment of signals to channels) from the names of the signals. It states
the likely channel of each signal, for a person to check.

Names are split into words at changes of case, digits and signs. A wheel is recognised by its two
letters or words, in English or German (VL VR HL HR: vorn = front and hinten = rear, links = left
and rechts = right). Units come from the recording if it states them.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Final, TypeAlias

from edge_agent.inputs.profile import Channel, Profile
from edge_agent.inputs.units import QUANTITY, unit_of_channel
from schemas.signals import WHEELS

UMLAUTS: Final = str.maketrans(
    {"ä": "ae", "ö": "oe", "ü": "ue", "Ä": "Ae", "Ö": "Oe", "Ü": "Ue", "ß": "ss"}
)
_WORDS: Final = re.compile(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|\d+")
PLACES: Final = {
    "fl": ("fl", "lf", "vl", "frontleft", "leftfront", "front left"),
    "fr": ("fr", "rf", "vr", "front right"),
    "rl": ("rl", "lr", "hl", "bl", "rear left"),
    "rr": ("rr", "hr", "br", "rear right"),
}
# Pair of regular expressions for a name. The name fits a channel if the first expression matches it
# and the second does not. The first fitting channel in RULES is used.
Rule: TypeAlias = tuple[str, str]
STATES: Final = "stat|diag|valid|q bit|fault|counter|check|alive|cov|std|v z|sta$"
ROLLS: Final = (
    r"omega|wheel.*(speed|spd|vel|rot)|whl.*(spd|speed)|rad.*geschw|(speed|spd).*w(hee|h)l|velocity"
)
SHORT: Final = r"wspd|w spd|^v .*w(hee|h)l|^(v|w(hee|h)l) (fl|fr|rl|rr)$"
SPEED: Final[Rule] = (rf"{ROLLS}|{SHORT}", rf"{STATES}|dir|torque")
RULES: Final[dict[str, Rule]] = {
    "yaw_rate": (
        r"yaw.*(rate|vel|rt)|gierrate|gyro.*z|angular.*velocity.*z|omega.*z|yawrt",
        STATES,
    ),
    "ax": (
        r"^a x$|long.*acc|acc.*long|acc.*x$|laengsbeschl|linear.*acceleration.*x|^ax$",
        rf"{STATES}|ang|jerk|target|desired",
    ),
    "ay": (
        r"^a y$|lat.*acc|acc.*lat|acc.*y$|querbeschl|linear.*acceleration.*y|^ay$",
        rf"{STATES}|ang|jerk|target|desired",
    ),
    "latitude": (r"^lat$|latitude|gps.*lat|breite", rf"{STATES}|acc|err|rate"),
    "longitude": (r"^lon$|^lng$|^long$|longitude|gps.*(lon|lng)|laenge$", rf"{STATES}|acc|err"),
    "yaw": (r"^yaw$|heading|course|track$", rf"{STATES}|rate|acc|err"),
    **{
        f"{name}_active": (
            rf"\b({words})\b.*\b(act|active|aktiv|engaged|ctl|bremsung|eingriff|anf)\b",
            rf"{STATES}|def\b|err|lamp|enabled|passi|switch|tast|off\b|mode",
        )
        for name, words in (("abs", "abs"), ("esc", "esc|esp|vsc|vdc"), ("tcs", "tcs|asr|trc|eds"))
    },
    "air_temperature": (
        r"(outside|outdoor|ambient|out|air) (air )?temp|aussen ?temp",
        rf"{STATES}|set|incar|cabin|intake|qbit|ind|int air",
    ),
    "wiper": (
        r"(wiper|wischer|wiping).*(active|aktiv|is wiping|front|vorne)",
        rf"{STATES}|rear|rr|hinten|wear|worn|err",
    ),
}
STEERING: Final[Rule] = (
    r"^delta|steer|lenk.*winkel|sas.*angle|lwi",
    (
        rf"{STATES}|rate|speed|geschw|torque|req|cmd|target|desired|init"
        r"|fraction|crc|qual|override|driver|cal|^sensor"
    ),
)
# Values of NavSatStatus.status and GPSStatus.status of a message with a position.
FIXES: Final = [0.0, 1.0, 2.0, 18.0, 33.0]
JOINT: Final = re.compile(r"\b(left|right)\b.*\bjoint\b")  # a steered wheel in a ROS model
COURSE: Final = re.compile(r"heading|course|track")


def split_words(name: str) -> str:
    """Return the name of a signal as lower-case words separated by blanks."""
    return " ".join(_WORDS.findall(name.translate(UMLAUTS))).lower()


def place_of(plain: str) -> str | None:
    """Return the wheel ("fl", "fr", "rl" or "rr") that the words of a signal's name (`plain`)
    denote; None if they denote no wheel.
    """
    tokens = plain.split()
    for wheel, spellings in PLACES.items():
        for spelling in spellings:
            if spelling in tokens or (
                " " in spelling and all(part in plain for part in spelling.split())
            ):
                return wheel
    return None


def draft_profile(signals: Mapping[str, str], name: str) -> Profile:
    """Return a draft of a profile, guessed from the names of the signals.

    Args:
        signals: name -> unit as recorded, "" where it is not given.
        name: name of the profile.
    """
    channels: dict[str, Channel] = {}
    for signal, unit in signals.items():
        field = signal.partition(".")[2]
        plain = split_words(signal if field in ("", "data") else field)
        if (channel := _channel_of(plain, signal)) and channel not in channels:
            channels[channel] = _make_channel(channel, signal, unit, plain)
            # A ROS message of a receiver states whether it has a fix (-1 is none).
            status = f"{signal.rpartition('.')[0]}.status.status"
            if channel in ("latitude", "longitude") and status in signals:
                valid = {status: FIXES}
                channels[channel] = channels[channel].model_copy(update={"valid": valid})
    about = (
        "Drafted from names: check every signal, unit and sign by hand, then with `edge-agent "
        "check`."
    )
    order = {channel: channels[channel] for channel in QUANTITY if channel in channels}
    return Profile(name=re.sub(r"\W+", "-", name)[:64] or "drafted", about=about, channels=order)


def _channel_of(plain: str, signal: str) -> str | None:
    if signal in QUANTITY:
        return signal
    place = place_of(plain)
    if place is not None and _fits_rule(plain, SPEED):
        return f"omega_{place}"
    if place is not None and "torque" in plain:
        return f"torque_{place}"
    for channel, rule in RULES.items():
        if _fits_rule(plain, rule):
            return channel
    if _fits_rule(plain, STEERING):
        if joint := JOINT.search(plain):
            return "delta_fl" if joint[1] == "left" else "delta_fr"
        return f"delta_{place}" if place in WHEELS else "delta_fl"
    return None


def _fits_rule(plain: str, rule: Rule) -> bool:
    return bool(re.search(rule[0], plain)) and not re.search(rule[1], plain)


def _make_channel(channel: str, signal: str, unit: str, plain: str) -> Channel:
    message, dot, short = signal.partition(".")
    bus = bool(dot) and not signal.startswith("/")
    wheel = (
        channel.startswith("delta")
        and place_of(plain) is None
        and not re.search(r"^delta|road|front", plain)
        and not JOINT.search(plain)
    )
    return Channel(
        signal=short if bus else signal,
        message=message if bus else None,
        unit=unit_of_channel(channel, unit),
        at="steering wheel" if wheel else "road wheel",
        course=channel == "yaw" and bool(COURSE.search(plain)),
    )
