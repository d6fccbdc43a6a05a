"""Encoder and decoder of the message about the road ahead of a vehicle. The message contains
warnings, and the map's values along the road ("horizon") as a sequence of road segments ("runs").
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final, Literal, NamedTuple

import numpy as np

from schemas.errors import WireError
from schemas.numeric import FloatArray, IntArray
from schemas.proto import gripmap_pb2 as pb
from schemas.wire.codec import encoding_of, parse

_HERE: Final = ("here_mu", "here_mu_lower", "here_mu_upper")
AHEAD_ENCODING: Final = encoding_of(pb.Ahead)
Way = Literal["route", "road", "corridor"]
WarningState = Literal["raised", "updated", "ended"]


@dataclass(frozen=True)
class GripWarning:
    """Warning of a slippery stretch of road ahead of the vehicle; its fields have the meaning of
    those in the protobuf message `Warning`.
    """

    id: str
    state: WarningState
    time: int
    distance_m: float
    length_m: float
    time_s: float
    mu: float
    mu_lower: float
    p_slippery: float
    age_s: float
    safe_speed: float
    way: Way
    sure: bool
    reason: str

    def line(self) -> str:
        """Return the warning as one line of text for the driver."""
        if self.state == "ended":
            return f"warning over: {self.reason}; id {self.id}"
        where = "here" if self.distance_m <= 0.0 else f"in {self.distance_m:.0f} m"
        return (
            f"slippery {where}, for {self.length_m:.0f} m: mu {self.mu:.2f} (at least "
            f"{self.mu_lower:.2f}), safe {3.6 * self.safe_speed:.0f} km/h, known for "
            f"{self.age_s:.0f} s; {self.reason}; "
            f"id {self.id}"
        )


class Runs(NamedTuple):
    """Horizon (the map's values for the road ahead) as n runs, with one array (n,) per field. A run
    is a segment of the route within one map cell and heading sector. The fields have the meaning of
    those in the protobuf message `Ahead`.
    """

    start_m: FloatArray
    end_m: FloatArray
    cell: IntArray
    sector: IntArray
    mu: FloatArray
    mu_lower: FloatArray
    mu_upper: FloatArray
    p_slippery: FloatArray
    age_s: FloatArray
    basis: IntArray
    safe_speed: FloatArray


class Outlook(NamedTuple):
    """The road ahead of one vehicle: the current warnings, and the horizon (the map's values) along
    the most probable route.

    `here` is the friction at the vehicle's position, computed from its own measurements and the
    map: median, 5 % and 95 % quantile; NaN if unknown.
    """

    vehicle: str
    time: int
    way: Way
    warnings: tuple[GripWarning, ...]
    runs: Runs
    here: tuple[float, float, float] = (math.nan, math.nan, math.nan)


def encode_ahead(outlook: Outlook) -> bytes:
    """Return the protobuf bytes of a vehicle's outlook (warnings, and the map's values for the road
    ahead).
    """
    columns: dict[str, Any] = {
        name: column.tolist() for name, column in outlook.runs._asdict().items()
    }
    here: dict[str, Any] = dict(zip(_HERE, outlook.here, strict=True))
    message = pb.Ahead(
        vehicle=outlook.vehicle, time=outlook.time, way=outlook.way, **here, **columns
    )
    message.warnings.extend(pb.Warning(**vars(warning)) for warning in outlook.warnings)
    return message.SerializeToString()


def decode_ahead(payload: bytes) -> Outlook:
    """Decode the bytes of a message about the road ahead; return the outlook (warnings, and the
    map's values for the road ahead).

    Raises:
        WireError: the payload is not an Ahead message, or its columns have different lengths.
    """
    message = parse(payload, AHEAD_ENCODING, pb.Ahead, AHEAD_ENCODING)
    whole = ("cell", "sector", "basis")
    runs = Runs._make(
        np.array(getattr(message, name), np.int64 if name in whole else np.float64)
        for name in Runs._fields
    )
    if len({len(column) for column in runs}) > 1:
        raise WireError("ahead", "has columns of different lengths", "send all of a run")
    warnings = tuple(
        GripWarning(**{name: getattr(one, name) for name in GripWarning.__dataclass_fields__})
        for one in message.warnings
    )
    here = (message.here_mu, message.here_mu_lower, message.here_mu_upper)
    return Outlook(message.vehicle, message.time, message.way, warnings, runs, here)
