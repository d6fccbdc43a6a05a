"""Profile of a recording, stored as validated JSON. It maps the signals of the recording, by name,
to channels of the signal log.

    value of a channel = scale · (sum of its signals, in SI) · sign + offset,
    at the time (time stamp − delay_s)

`wheel_radius` converts a speed at the rim to a wheel speed, and `steering_ratio` an angle of the
steering wheel to an angle of the road wheel. Radius and ratio of the vehicle file take precedence
over those of the profile.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Final, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from edge_agent.inputs.log_columns import FRONT_STEERING
from edge_agent.inputs.units import QUANTITY
from schemas.config import explain_validation_error, require_unique_names
from schemas.errors import InputError
from schemas.signals import CONTEXT, FLAGS

FOLDER: Final = Path(__file__).parent / "profiles"
Finite = Annotated[float, Field(allow_inf_nan=False)]
Text = Annotated[str, Field(min_length=1, max_length=200)]


class Part(BaseModel):
    """Base class of the records in a profile (assignment of signals to channels). It rejects
    unknown field names.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)


class Sign(Part):
    """Rule for the sign of a channel's value: the value is negative where the recorded signal
    `signal` equals `negative`.
    """

    signal: Text
    negative: Finite = 1.0


class Channel(Part):
    """Recorded signals from which a channel of the signal log is computed, and their conversion to
    SI units.
    """

    signal: Annotated[list[Text] | Text, Field(description="name, or names whose values are added")]
    message: Annotated[
        Text | None, Field(description="CAN message (default: taken from the signal's name)")
    ] = None
    source: Annotated[
        Text | None, Field(description="name of the file, if several files contain the signal")
    ] = None
    bus: Annotated[
        int | None,
        Field(ge=0, le=255, description="CAN bus (default: the bus that has the messages)"),
    ] = None
    unit: Annotated[str | None, Field(description="unit of the recorded value (default: SI)")] = (
        None
    )
    at: Literal["road wheel", "steering wheel"] = "road wheel"
    scale: Annotated[
        Finite, Field(description="additional factor; negative for a flipped sign")
    ] = 1.0
    offset: Annotated[Finite, Field(description="offset that is added last, in SI units")] = 0.0
    delay_s: Annotated[
        Finite, Field(ge=-10.0, le=10.0, description="delay of its time stamps [s]")
    ] = 0.0
    sign: Sign | None = None
    valid: Annotated[
        dict[Text, list[Finite]],
        Field(description="signal -> values at which the reading is valid"),
    ] = {}
    wrap: Annotated[
        float | None,
        Field(
            gt=0.0, description="recorded values are taken modulo this number (removes status bits)"
        ),
    ] = None
    course: Annotated[bool, Field(description="a heading, clockwise from north")] = False
    active: Annotated[
        list[Finite] | None, Field(description="values at which a flag is on (default: all but 0)")
    ] = None
    lasting: Annotated[
        bool, Field(description="sent only when it changes; the last value is held")
    ] = False

    @property
    def signals(self) -> list[str]:
        """Return the full names of the recorded signals whose sum gives the value of this channel
        of the signal log.
        """
        names = [self.signal] if isinstance(self.signal, str) else self.signal
        return [self.full_name(name) for name in names]

    @property
    def gates(self) -> dict[str, list[float]]:
        """Return the signals that state the validity of this channel's readings, by full name. Each
        has the list of its values that mean "valid".
        """
        return {self.full_name(name): values for name, values in self.valid.items()}

    def full_name(self, name: str) -> str:
        """Return the full name of a signal, as the readers of recordings use it: MESSAGE.SIGNAL if
        the channel has a CAN message.
        """
        return name if self.message is None else f"{self.message}.{name}"

    def needed_signals(self) -> list[str]:
        """Return the names of all recorded signals that this channel needs."""
        return [
            *self.signals,
            *self.gates,
            *([self.full_name(self.sign.signal)] if self.sign else []),
        ]


class Profile(Part):
    """Profile of one car or recorder: assigns its recorded signals to the channels of a signal
    log.
    """

    version: Literal[1] = 1
    name: Annotated[str, Field(min_length=1, max_length=64)]
    about: str = ""
    dbc: Annotated[Text | None, Field(description="CAN database, next to the profile")] = None
    time: Annotated[Text | None, Field(description="column that holds the time of a table")] = None
    time_unit: Literal["s", "ms", "us", "ns"] | None = None
    rate_hz: Annotated[
        float | None, Field(gt=0.0, le=1000.0, description="rows per second of the log")
    ] = None
    wheel_radius: Annotated[float | None, Field(gt=0.05, lt=2.0, description="[m]")] = None
    steering_ratio: Annotated[
        float | None, Field(gt=1.0, lt=60.0, description="steering wheel over road wheel")
    ] = None
    channels: dict[str, Channel]

    @model_validator(mode="after")
    def _check_channels(self) -> Self:
        for name, channel in self.channels.items():
            if name not in QUANTITY:
                raise ValueError(f"there is no channel {name}; choose one of {', '.join(QUANTITY)}")
            if channel.unit is not None and channel.unit not in QUANTITY[name]:
                raise ValueError(
                    f"{name} in {channel.unit}; choose one of {', '.join(QUANTITY[name])}"
                )
            if channel.active is not None and name not in FLAGS:
                raise ValueError(f"{name} has active values; only {', '.join(FLAGS)} have")
            if channel.lasting and name not in CONTEXT:
                raise ValueError(f"{name} cannot be `lasting`; only {', '.join(CONTEXT)} may be")
        left, right = FRONT_STEERING
        if left in self.channels and self.channels[left] == self.channels.get(right):
            # One measured angle is not the angle of both wheels; see `split_front_angle`.
            del self.channels[right]
        return self

    def needed_signals(self) -> set[str]:
        """Return the names of all recorded signals from which this profile computes the channels of
        the signal log.
        """
        return {name for channel in self.channels.values() for name in channel.needed_signals()}

    def to_json(self) -> str:
        """Return the profile as JSON, without unset fields."""
        return (
            json.dumps(self.model_dump(exclude_defaults=True) | {"version": self.version}, indent=1)
            + "\n"
        )


def shipped_profiles() -> list[str]:
    """Return the names of the profiles (assignments of signals to channels) that are part of the
    package.
    """
    return sorted(path.stem for path in FOLDER.glob("*.json"))


def load_profile(name: str) -> tuple[Profile, Path]:
    """Load a profile by path or by the name of a shipped profile; return it with the folder of its
    CAN database.

    Raises:
        InputError: the profile cannot be read, or a field is missing, unknown or out of range.
    """
    path = FOLDER / f"{name}.json" if name in shipped_profiles() else Path(name)
    try:
        text = path.read_bytes()
        require_unique_names(text, f"profile {path}")
        return Profile.model_validate_json(text), path.parent
    except OSError as error:
        known = ", ".join(shipped_profiles())
        raise InputError(
            "profile", f"cannot read {path} ({error.strerror})", f"name a file, or one of {known}"
        ) from error
    except ValidationError as error:
        raise explain_validation_error(error, f"profile {path}", Profile) from error
