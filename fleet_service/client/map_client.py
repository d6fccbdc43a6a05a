"""Client of the live map, used by the commands `query` and `watch` among others."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import zenoh

from schemas import grid, keys, query, regions, tables
from schemas.config import ServiceConfig, ZenohSettings, load_config
from schemas.errors import InputError, UnreachableError
from schemas.numeric import IntArray
from schemas.query import Format
from schemas.runtime import commandline, presence, zenoh_session
from schemas.wire.tile import decode_tile

log = logging.getLogger(__name__)
TIMEOUT_S: Final = 10.0
NAMED: Final = 5  # largest number of regions that a message names
PAST_S: Final = 60.0  # [s] time limit of a query about the past, which reads the archive
EVERYWHERE: Final = f"{keys.ROOT}/map/**"
SERVED_S: Final = 1.0  # [s] time within which a router states which services answer
# [s] If a service is killed, the router ends its queries and removes its token this much later.
FALLS_S: Final = 0.1
SHOWN: Final = (
    "latitude",
    "longitude",
    "sector",
    "mu",
    "mu_lower",
    "mu_upper",
    "p_slippery",
    "basis",
    "vehicles",
    "observations",
    "age_s",
)


@dataclass(frozen=True)
class Answer:
    """All replies to one map query, joined.

    Attributes:
        table: cells, if the answer is in Arrow format.
        document: content, if the answer is in another format.
        served: True if a service answered.
        missing: requested regions that have no service, or whose service stopped meanwhile.
        regions: regions that services announce.
    """

    table: pa.Table | None
    document: dict[str, object] | None
    served: bool = True
    missing: tuple[str, ...] = ()
    regions: tuple[str, ...] = ()

    @property
    def is_empty(self) -> bool:
        """Return True if the answer has no cell."""
        if self.table is not None:
            return not self.table.num_rows
        document = self.document or {}
        return not (document.get("features") or document.get("tiles"))

    @property
    def gap_description(self) -> str | None:
        """Return a description of the regions that are missing from the answer; None if it is
        complete.
        """
        if not self.missing:
            return None
        more = f" and {len(self.missing) - NAMED} more" if len(self.missing) > NAMED else ""
        names = ", ".join(self.missing[:NAMED])
        return f"no service answers for {names}{more}: the map is unknown there"


def connection_settings(connect: str | None, config: Path | str | None) -> ZenohSettings:
    """Return the Zenoh connection settings from a configuration file; if `connect` is given, it
    replaces the endpoints.
    """
    return load_config(config, ServiceConfig).zenoh.with_endpoint(connect)


def query_map(connection: ZenohSettings, parameters: Mapping[str, str]) -> Answer:
    """Query all services for the map.

    Raises:
        InputError: the query is refused, here or by a service, or no router answers.
    """
    map_query = query.parse(parameters)
    with open_connected(connection) as session, presence.track_tokens(session) as services:
        before = services.active
        payloads = sorted(query_replies(session, EVERYWHERE, parameters))
        time.sleep(FALLS_S)
        # Services that started during the query may not have received it.
        after = services.refresh(session)
        # A service that ended may have received the query instead of its successor. This holds even
        # if the service has started again.
        withdrawn = {token.region for token in services.ever_lost | (before - after)}
        stayed = {token.region for token in before & after}
        fully_served = {
            one for one in stayed if not any(regions.overlap(one, region) for region in withdrawn)
        }
        declared = bool(before | after)
        if declared:
            served = bool(payloads or fully_served)
        else:
            served = bool(payloads) or is_served(session, map_query)
            if services.refresh(session):  # a service started during the check
                declared = True
                served = bool(payloads)
            elif served and not payloads:
                # The service started during the check and will declare its token, or it declares
                # none.
                payloads = sorted(query_replies(session, EVERYWHERE, parameters))
    answer = replace(_join_replies(map_query, [payload for _, payload in payloads]), served=served)
    if not declared:  # services without tokens: an older version, or an access list of one
        return answer
    tiles = {
        regions.region_of(tile)
        for key, _ in payloads
        if (tile := keys.parse(key).quadint) is not None
    }
    fully_served |= {
        one for one in tiles if not any(regions.overlap(one, region) for region in withdrawn)
    }
    has_place = map_query.bbox is not None or map_query.route is not None
    missing = (
        regions.unserved_expressions(map_query, fully_served) if has_place else sorted(withdrawn)
    )
    found = tuple(sorted({token.region for token in after}))
    return replace(answer, missing=tuple(missing), regions=found)


def query_replies(
    session: zenoh.Session, key: str, parameters: Mapping[str, str]
) -> Iterator[tuple[str, bytes]]:
    """Query a Zenoh key expression of the map, and yield key and payload of every reply.

    Raises:
        InputError: a service refused the query.
    """
    text = ";".join(f"{name}={value}" for name, value in parameters.items())
    timeout = PAST_S if "at" in parameters else TIMEOUT_S
    selector = f"{key}?{text}" if text else key
    for reply in session.get(selector, timeout=timeout):
        if reply.ok is None:
            reason = reply.err.payload.to_string() if reply.err else "no reply"
            field, _, rest = reason.partition(": ")
            problem, _, fix = rest.partition("; ")
            raise InputError(field if rest else "query", problem or reason, fix or "ask again")
        yield str(reply.ok.key_expr), reply.ok.payload.to_bytes()


def served_table(answer: Answer) -> pa.Table:
    """Return the cells of an Arrow answer. Missing regions are logged, and named in the metadata of
    the schema.

    Raises:
        InputError: no service answered, or the answer is empty and a part of the area has no
            service.
    """
    if not answer.served or answer.table is None:
        raise InputError(
            "connect",
            "no service answers for the map",
            "start one; this is not the same as an empty map",
        )
    if answer.gap_description is None:
        return answer.table
    if not answer.table.num_rows:
        raise InputError(
            "connect",
            answer.gap_description,
            "start its service; this is not the same as an empty map",
        )
    log.warning("%s", answer.gap_description)
    return answer.table.replace_schema_metadata({"missing": ",".join(answer.missing)})


def is_served(session: zenoh.Session, map_query: query.MapQuery) -> bool:
    """Return True if there is any sign of a service for the queried part of the map. This
    distinguishes an empty map from a missing service.

    Three signs are checked in turn, because each may be absent although a service runs:

    1. A service answers for one tile. It is the tile at the start of the queried route or at a
       corner of the queried box. For a query without a place, it is the tile at latitude and
       longitude 0, for which a service of limited regions usually does not answer.
    2. If the query names no place, a service replies to a query of the whole map.
    3. A service's liveliness token is visible. Not every reader may see tokens.
    """
    point = None
    if map_query.route:
        point = map_query.route[0]
    elif map_query.bbox:
        point = map_query.bbox[:2]
    longitude, latitude = point or (0.0, 0.0)
    if is_place_served(session, latitude, longitude):
        return True
    if point is None and any(True for _ in query_replies(session, EVERYWHERE, {})):
        return True
    return any(
        reply.ok is not None
        for reply in session.liveliness().get(f"{keys.ROOT}/shard/*", timeout=SERVED_S)
    )


def is_place_served(session: zenoh.Session, latitude: float, longitude: float) -> bool:
    """Return True if a service answers for the tile of a place [deg]. If none does, this takes
    SERVED_S [s].
    """
    tile = grid.tile_of(int(grid.cell_of(latitude, longitude)))
    querier: Any = session.declare_querier(keys.map_key(int(tile)))
    deadline = time.monotonic() + SERVED_S
    while not querier.matching_status.matching:
        if time.monotonic() > deadline:
            return False
        time.sleep(0.02)
    return True


def open_connected(connection: ZenohSettings) -> zenoh.Session:
    """Return a Zenoh session that is connected to a router.

    Raises:
        UnreachableError: no router answers.
    """
    config = zenoh_session.configuration(connection)
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        where = ", ".join(connection.connect)
        fix = "start one with `gripmap router`, or name its endpoint with --connect"
        if where.startswith(("tls/", "quic/")):
            fix += "; its log names an expired certificate"
        faults = zenoh_session.explain_faults(config)
        raise UnreachableError("connect", f"no router at {where}", faults or fix) from error


def _join_replies(map_query: query.MapQuery, payloads: list[bytes]) -> Answer:
    """Join the replies to a query into one answer; along a route, cells are in driving order."""
    rank = regions.Rank(map_query.route) if map_query.route else None
    if map_query.format is Format.ARROW:
        parts = [decode_tile(payload) for payload in payloads]
        table = pa.concat_tables(parts) if parts else tables.MAP_SCHEMA.empty_table()
        if rank is not None:
            table = table.take(
                rank.order(_column_array(table["cell"]), _column_array(table["sector"]))
            )
        return Answer(table, None)
    documents = [json.loads(payload) for payload in payloads]
    if map_query.format is Format.JSON:
        return Answer(
            None, {"tiles": documents if rank is None else sorted(documents, key=_tile_rank(rank))}
        )
    features = [feature for document in documents for feature in document["features"]]
    if rank is not None:
        features.sort(
            key=lambda feature: rank.of(
                feature["properties"]["cell"], feature["properties"]["sector"]
            )
        )
    return Answer(None, {"type": "FeatureCollection", "features": features})


def _column_array(column: pa.ChunkedArray[Any]) -> IntArray:
    return np.asarray(column.to_numpy(), np.int64)


def _tile_rank(rank: regions.Rank) -> Callable[[dict[str, Any]], int]:
    return lambda tile: min(rank.of(cell["cell"], cell["sector"]) for cell in tile["cells"])


def write_answer(answer: Answer, path: Path) -> None:
    """Write the answer to a map query to a file, as an Arrow stream or as JSON.

    Raises:
        InputError: the file cannot be written.
    """
    with commandline.report_write_errors(path):
        if answer.table is None:
            path.write_text(json.dumps(answer.document))
        else:
            with (
                pa.OSFile(str(path), "wb") as sink,
                pa.ipc.new_stream(sink, answer.table.schema) as writer,
            ):
                writer.write_table(answer.table)


def format_answer(answer: Answer) -> str:
    """Return the answer to a map query as text for the terminal."""
    if answer.table is None:
        return json.dumps(answer.document, indent=1)
    lines = ["  ".join(f"{name:>12}" for name in SHOWN)]
    for row in answer.table.select(SHOWN).to_pylist():
        row["sector"] = grid.HEADINGS[row["sector"]]
        lines.append("  ".join(f"{_format_value(name, row[name]):>12}" for name in SHOWN))
    return "\n".join([*lines, f"{answer.table.num_rows} cells"])


def _format_value(name: str, value: object) -> str:
    if value is None:
        return "-"
    if not isinstance(value, float):
        return str(value)
    return f"{value:.6f}" if name in ("latitude", "longitude") else f"{value:.2f}"
