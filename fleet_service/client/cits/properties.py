"""Application properties of a DENM (hazard message) at an AMQP interchange of C-ROADS and
NordicWay. Pure (no I/O).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any, Final

from fleet_service.client.cits.denm import Denm, its_time
from schemas import grid
from schemas.errors import InputError

QUAD_ZOOM: Final = 18  # length of the longest quadtree key that interchanges index
PROTOCOL: Final = "DENM:1.3.1"


@dataclass(frozen=True)
class Originator:
    """Publisher of messages at an interchange (AMQP server for hazard messages).

    Attributes:
        country: two letters, ISO 3166.
        publisher: identifier of the publisher, by convention the country and five digits, e.g.
            SE00001.
        publication: name of this publication of the publisher.

    Raises:
        InputError: country or publisher is not valid.
    """

    country: str
    publisher: str
    publication: str = "gripmap"

    def __post_init__(self) -> None:
        """Check the fields country and publisher; raise InputError if one is not valid."""
        if not re.fullmatch("[A-Z]{2}", self.country):
            raise InputError(
                "country",
                f"{self.country!r} is not a country code",
                "give two capital letters, e.g. SE",
            )
        if not self.publisher.strip():
            raise InputError(
                "publisher", "is empty", "give the publisher's identifier at the interchange"
            )


def message_properties(denm: Denm, originator: Originator) -> dict[str, Any]:
    """Return the properties by which subscribers select messages.

    The property `quadTree` contains the quadkeys of all points of the event, each between commas.
    So `quadTree LIKE '%,120002%'` selects all events within a square.
    """
    return {
        "messageType": "DENM",
        "protocolVersion": PROTOCOL,
        "publisherId": originator.publisher,
        "publicationId": f"{originator.publisher}:{originator.publication}",
        "originatingCountry": originator.country,
        "quadTree": quadtree_keys(denm),
        "latitude": denm.position[0],
        "longitude": denm.position[1],
        "timestamp": its_time(denm.referenced),
        "causeCode": denm.cause,
        "subCauseCode": denm.sub_cause,
        # C-ROADS: hazardous location notification, weather condition warning
        "serviceType": "HLN-WCW",
        "shardId": 1,
        "shardCount": 1,
    }


def quadtree_keys(denm: Denm) -> str:
    """Return the quadkeys of all squares that a hazard event touches, separated and enclosed by
    commas.
    """
    latitude, longitude = zip(denm.position, *denm.history, strict=True)
    squares = set(grid.cell_of(latitude, longitude, zoom=QUAD_ZOOM).tolist())
    return f",{','.join(sorted(grid.quadkey(square, QUAD_ZOOM) for square in squares))},"
