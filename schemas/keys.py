"""Zenoh keys of the contract (common definitions of vehicles, service and clients): the topics with
their messages and quality of service. Keys are built and parsed only here.

The quadkey (digits of a quadtree path) of a region is split into chunks of 4, 3 and 3 digits, that
of a tile into chunks of 4, 3, 3 and 4. Therefore wildcards select areas of different size:
`gripmap/v1/map/1200/320/*/*` is a zone (zoom 7).
"""

from __future__ import annotations

import re
from typing import Final, NamedTuple

from schemas import grid
from schemas.config import NAME_PATTERN, REGION_PATTERN
from schemas.errors import InputError

ROOT: Final = "gripmap/v1"
# Liveliness tokens of the services that serve a region, see `ServiceToken`.
SERVES: Final = f"{ROOT}/serves"
# Tokens of the services that own a region. A service holds this token from before its first answer
# until after its last one.
CLAIMS: Final = f"{ROOT}/claims"
WAITS: Final = f"{ROOT}/waits"  # tokens of the standby services of a region
# Topics of one vehicle, which only the vehicle and its owner may read.
PRIVATE: Final = ("ahead", "vss")
_ALL: Final = "all"
_CHUNKS: Final = (4, 3, 3, 4)


class Topic(NamedTuple):
    """Kind of Zenoh key, with its message and quality of service.

    Attributes:
        name: first chunk of the key after the root.
        zoom: zoom of the grid square in the key; None if the key has no grid square.
        has_name: True if the last chunk is a name (of a vehicle or a service).
        message: type of the payload; None for a liveliness token (sign that a process is alive).
        priority: name of the Zenoh priority.
        block: on an overloaded link, the sender waits (True) or the message is dropped (False).
        express: True to send at once, False to wait up to a millisecond for other messages in the
            same frame.
    """

    name: str
    zoom: int | None
    has_name: bool
    message: str | None
    priority: str
    block: bool
    express: bool = False


TOPICS: Final = {
    topic.name: topic
    for topic in (
        Topic("obs", grid.REGION_ZOOM, True, "gripmap.v1.ObservationBatch", "DATA", True),
        Topic("state", grid.REGION_ZOOM, True, "gripmap.v1.StateBatch", "DATA_LOW", True),
        Topic("ack", None, True, "gripmap.v1.Ack", "DATA_HIGH", True),
        Topic("map", grid.TILE_ZOOM, False, "Arrow stream", "DATA_LOW", False),
        Topic("alert", grid.TILE_ZOOM, False, "gripmap.v1.Alert", "REAL_TIME", True, express=True),
        Topic("ahead", None, True, "gripmap.v1.Ahead", "DATA_HIGH", False, express=True),
        Topic("vss", None, True, "JSON of VSS signals", "DATA_HIGH", False),
        Topic("weather", grid.REGION_ZOOM, False, "gripmap.v1.Weather", "DATA", True),
        Topic("alive", None, True, None, "DATA", True),
        Topic("shard", None, True, None, "DATA", True),
    )
}


def chunks(quadint: int, zoom: int) -> str:
    """Return the quadkey digits of a region or tile as in a Zenoh key: chunks separated by slashes,
    of 4, 3 and 3 digits for a region (zoom 10), of 4, 3, 3 and 4 for a tile (zoom 14).
    """
    digits = grid.quadkey(quadint, zoom)
    parts = []
    for size in _CHUNKS:
        if digits:
            parts.append(digits[:size])
            digits = digits[size:]
    return "/".join(parts)


def observation_key(region: int, vehicle: str) -> str:
    """Return the Zenoh key under which a vehicle publishes its observations (one report per visited
    map cell) in a region.
    """
    return f"{ROOT}/obs/{chunks(region, grid.REGION_ZOOM)}/{vehicle}"


def state_key(region: int, vehicle: str) -> str:
    """Return the key under which a vehicle publishes its states (position, motion and friction at a
    fixed rate) in a region.
    """
    return f"{ROOT}/state/{chunks(region, grid.REGION_ZOOM)}/{vehicle}"


def ack_key(vehicle: str) -> str:
    """Return the Zenoh key under which a vehicle receives its acknowledgements."""
    return f"{ROOT}/ack/{vehicle}"


def map_key(tile: int) -> str:
    """Return the Zenoh key under which a map tile is published."""
    return f"{ROOT}/map/{chunks(tile, grid.TILE_ZOOM)}"


def alert_key(tile: int) -> str:
    """Return the Zenoh key under which the alerts of a map tile are published."""
    return f"{ROOT}/alert/{chunks(tile, grid.TILE_ZOOM)}"


def ahead_key(vehicle: str) -> str:
    """Return the key under which a vehicle publishes messages about the road ahead of it: warnings,
    and the friction along its route.
    """
    return f"{ROOT}/ahead/{vehicle}"


def vss_key(vehicle: str) -> str:
    """Return the key under which a vehicle publishes its friction as signals of the Vehicle Signal
    Specification (VSS).
    """
    return f"{ROOT}/vss/{vehicle}"


def private_keys(vehicle: str) -> list[str]:
    """Return the Zenoh keys of messages that only the vehicle and its owner may read."""
    return [ahead_key(vehicle), vss_key(vehicle)]


def weather_key(region: int) -> str:
    """Return the Zenoh key under which the weather of a region is published."""
    return f"{ROOT}/weather/{chunks(region, grid.REGION_ZOOM)}"


def alive_key(vehicle: str) -> str:
    """Return the key of a vehicle's liveliness token, which exists in Zenoh while the vehicle is
    connected.
    """
    return f"{ROOT}/alive/{vehicle}"


def shard_key(service: str) -> str:
    """Return the key of a service's liveliness token, which exists in Zenoh while the service is
    running.
    """
    return f"{ROOT}/shard/{service}"


class ServiceToken(NamedTuple):
    """Announcement that a service serves a region. It is a Zenoh liveliness token, which exists as
    long as the service runs.

    Attributes:
        region: key expression of the region, three chunks separated by slashes. The chunks have 4,
            3 and 3 quadkey digits (0 to 3). `*` in place of a chunk stands for any digits, for
            example `1200/320/*`.
        service: name of the service.
        start: identifier that differs for each start of the service.
    """

    region: str
    service: str
    start: str

    @property
    def key(self) -> str:
        """Return the key of the token: `gripmap/v1/serves/<region>/<service>/<start>`, with `all`
        in place of `*` in the region, because a concrete key must not contain `*`.
        """
        return self.key_under(SERVES)

    def key_under(self, root: str) -> str:
        """Return the token's key with `root` as first part instead of `gripmap/v1/serves`. The root
        CLAIMS means that the service serves or will soon serve the region. The root WAITS means
        that it is a standby service for the region.
        """
        return f"{root}/{self.region.replace('*', _ALL)}/{self.service}/{self.start}"


def parse_served(key: str, root: str = SERVES) -> ServiceToken:
    """Parse the key of a service's token (sign that it is alive).

    Raises:
        InputError: the key does not belong to a service's token.
    """
    *found, service, start = ["", "", *key.removeprefix(f"{root}/").split("/")]
    region = "/".join(found[2:]).replace(_ALL, "*")
    if not key.startswith(f"{root}/") or not re.fullmatch(REGION_PATTERN, region):
        raise InputError("key", f"{key[:80]!r} names no service's region", "see `ServiceToken`")
    return ServiceToken(region, service, start)


class Parsed(NamedTuple):
    """Parts of a concrete key (without wildcards): topic, quadint (number of a grid square), and
    name of a vehicle or service. Quadint or name is None if keys of this topic do not contain it.
    """

    topic: Topic
    quadint: int | None
    name: str | None


def parse(key: str) -> Parsed:
    """Parse a concrete key (without wildcards) into topic, number of the grid square, and name of
    the vehicle or service.

    Raises:
        InputError: the key has a wildcard, an unknown topic, a wrong number of chunks or digits, or
            an invalid name.
    """
    head, _, rest = key.removeprefix(ROOT + "/").partition("/")
    topic = TOPICS.get(head)
    if not key.startswith(ROOT + "/") or topic is None:
        raise InputError(
            "key",
            f"{key[:80]!r} is not a GripMap key",
            f"use {ROOT}/ and one of {', '.join(TOPICS)}",
        )
    parts = rest.split("/")
    name = parts.pop() if topic.has_name else None
    if name is not None and not re.fullmatch(NAME_PATTERN, name):
        raise InputError("key", f"{name[:80]!r} is not a name", f"use {NAME_PATTERN}")
    digits = "".join(parts)
    sizes = _CHUNKS[: len(parts)] if topic.zoom else ()
    if (
        (topic.zoom or 0) != len(digits)
        or [len(part) for part in parts] != list(sizes)
        or set(digits) - set("0123")
    ):
        raise InputError(
            "key",
            f"{key[:80]!r} has no valid quadkey",
            f"give {topic.zoom or 0} quadkey digits in chunks of {_CHUNKS}",
        )
    return Parsed(topic, grid.from_quadkey(digits) if topic.zoom else None, name)
