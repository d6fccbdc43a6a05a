"""Road weather reports: decoding and validation. An unknown temperature or precipitation is NaN.

A report applies to a region (grid square of zoom 10) from a time on. Each value is optional, but at
least one must be given.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from schemas import mugrid, wire
from schemas.errors import WireError
from schemas.proto import gripmap_pb2 as pb

# Values that are possible on Earth. Anything else is a sender's fault, such as a wrong unit or a
# filler like -9999.
RANGES: Final = {
    "air_temperature": (-90.0, 60.0),
    "road_temperature": (-90.0, 90.0),
    "precipitation": (0.0, 500.0),
}
PRIOR_SUM_ERROR: Final = 0.01  # tolerance of the sum: float32 values, or a few digits of text


@dataclass(frozen=True)
class Report:
    """Weather of a region (grid square of zoom 10) from the time `time` [ns UTC] on.

    Air and road temperature are in °C and precipitation in mm/h of water, each NaN where unknown.
    `prior` is a friction distribution (32,) of the region's roads, or None.
    """

    time: int
    air_temperature: float = np.nan
    road_temperature: float = np.nan
    precipitation: float = np.nan
    prior: NDArray[np.float64] | None = None


def decode_report(payload: bytes, encoding: str = wire.WEATHER_ENCODING) -> Report:
    """Read a report from protobuf or JSON, and validate it.

    Raises:
        WireError: the payload is not a Weather message, a value is out of range, the prior is not a
            distribution, or no value is given.
    """
    message: Any = wire.parse(payload, encoding, pb.Weather, wire.WEATHER_ENCODING)
    values = {name: getattr(message, name) if message.HasField(name) else np.nan for name in RANGES}
    prior = np.array(message.prior, np.float64) if len(message.prior) else None
    problem = find_report_error(values, prior)
    if problem is not None:
        raise problem
    return Report(message.time, prior=prior, **values)


def find_report_error(
    values: dict[str, float], prior: NDArray[np.float64] | None
) -> WireError | None:
    """Return an error for the first rule that a weather report violates; None if the report is
    valid. `values` are the report's numbers by name, `prior` its friction distribution (32,) or
    None.
    """
    for name, (least, most) in RANGES.items():
        if not (np.isnan(values[name]) or least <= values[name] <= most):
            return WireError(
                name,
                f"{values[name]:g} lies outside [{least:g}, {most:g}]",
                "omit unknown values",
            )
    if prior is None:
        if all(np.isnan(value) for value in values.values()):
            return WireError("weather", "has no value", f"give one of {', '.join(RANGES)} or prior")
        return None
    if prior.shape != (mugrid.BINS,):
        return WireError(
            "prior",
            f"has {prior.size} bins",
            f"give {mugrid.BINS}, those of the friction grid, or none",
        )
    if not (
        np.isfinite(prior).all()
        and (prior >= 0.0).all()
        and abs(prior.sum() - 1.0) <= PRIOR_SUM_ERROR
    ):
        return WireError(
            "prior", "is not a probability distribution", "give finite numbers from 0 that sum to 1"
        )
    return None
