"""Parameters of a map query, that is, of the Zenoh query `get gripmap/v1/map/**?…`."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from enum import StrEnum
from typing import Annotated, Final

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from schemas import wire
from schemas.errors import InputError

MAX_ROUTE_POINTS: Final = 500
# [characters] Largest length of all parameters together. A route of 500 points with seven decimals
# takes 13 kB.
MAX_TEXT: Final = 32 * 1024
# Earliest year of a query; nanoseconds since 1970 are then positive in every time zone.
FIRST_YEAR: Final = 1971
_FIXES: Final = {
    "bbox": "give bbox=west,south,east,north in degrees, west < east and south < north",
    "route": f"give route=lon,lat|lon,lat with 2 to {MAX_ROUTE_POINTS} points in degrees",
    "min_vehicles": "give a whole number from 1",
    "format": "give format=arrow, geojson or json",
    "at": "give a time like at=2026-01-31T07:00:00Z; without a zone it is UTC",
    "basis": "give basis=borrowed, or leave it out",
}


class Format(StrEnum):
    """Data format of an answer to a map query."""

    ARROW = "arrow"
    GEOJSON = "geojson"
    JSON = "json"

    @property
    def encoding(self) -> str:
        """Return the name of the Zenoh encoding of an answer in this data format."""
        return {"arrow": wire.ARROW, "geojson": wire.GEOJSON, "json": wire.JSON}[self.value]


Degrees = Annotated[float, Field(ge=-180.0, le=180.0, allow_inf_nan=False)]


class MapQuery(BaseModel):
    """Parsed map query; a parameter that was not given is None."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    bbox: tuple[Degrees, Degrees, Degrees, Degrees] | None = None
    route: tuple[tuple[Degrees, Degrees], ...] | None = None
    min_vehicles: int = Field(default=1, ge=1, le=1_000_000)
    format: Format = Format.ARROW
    at: datetime | None = None
    basis: str | None = Field(default=None, pattern="^borrowed$")

    @field_validator("bbox", mode="before")
    @classmethod
    def _split_bbox(cls, value: object) -> object:
        return value.split(",") if isinstance(value, str) else value

    @field_validator("bbox")
    @classmethod
    def _check_order(
        cls, value: tuple[float, float, float, float] | None
    ) -> tuple[float, float, float, float] | None:
        if value is not None and not (value[0] < value[2] and value[1] < value[3]):
            raise ValueError("west < east and south < north do not hold")
        return value

    @field_validator("route", mode="before")
    @classmethod
    def _split_route(cls, value: object) -> object:
        if not isinstance(value, str):
            return value
        points = value.split("|")
        if not 2 <= len(points) <= MAX_ROUTE_POINTS:
            raise ValueError(f"has {len(points)} points")
        return [point.split(",") for point in points]

    @field_validator("at")
    @classmethod
    def _check_zone(cls, value: datetime | None) -> datetime | None:
        if value is None:
            return None
        if value.year < FIRST_YEAR:
            raise ValueError("lies before all reports")
        return value if value.tzinfo else value.replace(tzinfo=UTC)


def parse(parameters: Mapping[str, str]) -> MapQuery:
    """Parse the text parameters of a map query; return the query with parsed values.

    Raises:
        InputError: a parameter is unknown or not valid; the error names it and the fix.
    """
    if sum(len(name) + len(value) for name, value in parameters.items()) > MAX_TEXT:
        raise InputError("query", f"is longer than {MAX_TEXT} characters", "shorten the query")
    try:
        return MapQuery.model_validate(dict(parameters))
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False)[0]
        name = str(first["loc"][0])
        unknown = first["type"] == "extra_forbidden"
        own = first["type"] == "value_error"
        because = f" ({first['msg'].removeprefix('Value error, ')})" if own else ""
        if not unknown and "&" in parameters[name]:
            raise InputError(
                name[:60],
                "contains '&'",
                "separate the parameters by ';', as in bbox=W,S,E,N;format=json",
            ) from error
        problem = (
            "is not a parameter" if unknown else f"{parameters[name][:60]!r} is not usable{because}"
        )
        raise InputError(
            name[:60], problem, _FIXES.get(name, f"use {', '.join(MapQuery.model_fields)}")
        ) from error
