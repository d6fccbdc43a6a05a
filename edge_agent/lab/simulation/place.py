"""Conversion between positions on earth and coordinates in metres: x to the east, y to the north of
an origin.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from schemas.numeric import FloatArray
from schemas.thresholds import EARTH_RADIUS_M


@dataclass(frozen=True)
class Origin:
    """Position on earth [deg, WGS 84] of the point x = y = 0."""

    latitude: float
    longitude: float

    @property
    def per_metre(self) -> tuple[float, float]:
        """Return the degrees of latitude per metre north, and the degrees of longitude per metre
        east, at this origin.
        """
        north = float(np.degrees(1.0 / EARTH_RADIUS_M))
        return north, north / float(np.cos(np.radians(self.latitude)))

    def to_latlon(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return (latitude, longitude) [deg] of the points (x, y) [m]."""
        north, east = self.per_metre
        return self.latitude + np.asarray(y) * north, self.longitude + np.asarray(x) * east

    def from_latlon(
        self, latitude: FloatArray, longitude: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the coordinates (x, y) [m] of points given by latitude and longitude [deg]."""
        north, east = self.per_metre
        return (np.asarray(longitude) - self.longitude) / east, (
            np.asarray(latitude) - self.latitude
        ) / north


GOTHENBURG: Final = Origin(57.70, 11.97)
