"""Directed links of a road network, read from an OpenStreetMap extract or from any file of lines
with ids.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from hashlib import sha256
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from schemas.errors import InputError
from schemas.numeric import FloatArray
from schemas.runtime.installing import install_command

EXTRACT: Final = (".pbf", ".osm", ".osm.gz", ".osm.bz2")
LINES: Final = (".gpkg", ".geojson", ".shp", ".fgb", ".parquet")
CLASSES: Final = (
    "motorway",
    "motorway_link",
    "trunk",
    "trunk_link",
    "primary",
    "primary_link",
    "secondary",
    "secondary_link",
    "tertiary",
    "tertiary_link",
    "unclassified",
    "residential",
    "living_street",
    "service",
)  # values of OpenStreetMap's tag `highway` on which cars may drive
MOST_NAMES: Final = 5  # maximum number of ids in a note
FORWARD = "forward"
BACKWARD = "backward"
_ONLY_FORWARD: Final = frozenset({"yes", "true", "1", FORWARD})
_ONLY_BACKWARD: Final = frozenset({"-1", "reverse", BACKWARD})


class DirectedLink(NamedTuple):
    """One direction of a road.

    Attributes:
        id: id of the road in its network; the same for both directions.
        direction: forward (as it is drawn) or backward.
        name, kind: name and kind of the road; empty if the network does not state them.
        latitude, longitude: (n,) [deg] in the order of travel.
    """

    id: str
    direction: str
    name: str
    kind: str
    latitude: FloatArray
    longitude: FloatArray


class RoadNetwork(NamedTuple):
    """Road links that were read from a file, information about the file (name, digest, date and
    licence), and remarks for the user.
    """

    links: list[DirectedLink]
    source: dict[str, str]
    notes: tuple[str, ...] = ()


def read_network(path: Path, identity: str = "id", name: str = "name") -> RoadNetwork:
    """Return the links of an OpenStreetMap extract (.osm.pbf, .osm), or of the lines in a file
    (GeoPackage, GeoJSON …).

    Args:
        path: path of the file.
        identity: column of the id, for a file of lines.
        name: column of the road's name, for a file of lines; optional, like the columns `oneway`
            (forward, backward, yes, no) and `kind`.

    Raises:
        InputError: the file cannot be read, has no such column, or contains no road; or a package
            to read it is not installed.
    """
    if not path.is_file():
        raise InputError(
            "extract", f"{path} does not exist", "name an .osm.pbf, or a GeoPackage of lines"
        )
    source = {"extract": path.name, "sha256": sha256(path.read_bytes()).hexdigest()}
    if path.name.endswith(EXTRACT):
        links, about = _read_openstreetmap(path)
        notes: tuple[str, ...] = ()
    elif path.name.endswith(LINES):
        links, notes = _read_lines(path, identity, name)
        about = {}
    else:
        known = ", ".join((*EXTRACT, *LINES))
        raise InputError("extract", f"{path.name} has an unknown ending", f"give one of {known}")
    if not links:
        raise InputError(
            "extract", f"{path.name} contains no road for cars", "name another extract"
        )
    return RoadNetwork(links, source | about, notes)


def _read_openstreetmap(path: Path) -> tuple[list[DirectedLink], dict[str, str]]:
    try:
        import osmium
    except ImportError as error:
        raise InputError("extract", "osmium is not installed", install_command("roads")) from error
    links: list[DirectedLink] = []
    try:
        date = osmium.io.Reader(str(path)).header().get("osmosis_replication_timestamp", "")
        found = (
            osmium.FileProcessor(str(path))
            .with_locations()
            .with_filter(osmium.filter.KeyFilter("highway"))
        )
        for way in found:
            if not isinstance(way, osmium.osm.Way) or way.tags.get("highway") not in CLASSES:
                continue
            points = np.array(
                [(node.lat, node.lon) for node in way.nodes if node.location.valid()]
            ).reshape(-1, 2)
            tags = dict(way.tags)
            kind = tags["highway"]
            name = tags.get("name", tags.get("ref", ""))
            by_rule = tags.get("junction") in ("roundabout", "circular") or kind.startswith(
                "motorway"
            )
            oneway = tags.get("oneway", "yes" if by_rule else "no")
            links += _driven_directions(str(way.id), name, kind, oneway, points)
    except (RuntimeError, ValueError, OSError) as error:
        problem = f"{path.name} cannot be read ({str(error).splitlines()[0][:100]})"
        raise InputError("extract", problem, "name a complete extract") from error
    return links, {"date": date, "licence": "ODbL 1.0, © OpenStreetMap contributors"}


def _read_lines(path: Path, identity: str, name: str) -> tuple[list[DirectedLink], tuple[str, ...]]:
    try:
        import geopandas
    except ImportError as error:
        raise InputError(
            "extract", "geopandas is not installed", install_command("roads")
        ) from error
    try:
        frame: Any = (
            geopandas.read_parquet(path) if path.suffix == ".parquet" else geopandas.read_file(path)
        )
    except Exception as error:  # each reader has exceptions of its own
        problem = (
            f"{path.name} cannot be read "
            f"({(str(error) or 'no reason given').splitlines()[0][:100]})"
        )
        raise InputError("extract", problem, "name a file of lines") from error
    if identity not in frame.columns:
        raise InputError(
            "id",
            f"{path.name} has no column {identity!r}",
            f"use one of {', '.join(frame.columns)}",
        )
    if frame.crs is not None:
        frame = frame.to_crs(4326)
    links: list[DirectedLink] = []
    for row in frame.explode(index_parts=False).itertuples():
        about = row._asdict()
        if about["geometry"] is None or about["geometry"].geom_type != "LineString":
            continue
        points = np.asarray(about["geometry"].coords)[:, [1, 0]]
        if not (np.isfinite(points).all() and (np.abs(points) <= (90.0, 180.0)).all()):
            raise InputError(
                "extract",
                f"{path.name} has coordinates that are not degrees",
                "give the file its CRS",
            )
        if not (own := _text_of(about[identity])):
            problem = f"a line of {path.name} has no {identity!r}"
            fix = "give each line an id, or name another column with --id"
            raise InputError("id", problem, fix)
        called, kind, oneway = (_text_of(about.get(column)) for column in (name, "kind", "oneway"))
        links += _driven_directions(own, called, kind, oneway, points)
    return links, _note_repeated_ids([_text_of(value) for value in frame[identity]], identity)


def _note_repeated_ids(ids: Sequence[str], identity: str) -> tuple[str, ...]:
    """Return a note if several roads have the same id, because each id gets one answer."""
    repeated = [own for own, count in Counter(ids).items() if count > 1]
    if not repeated:
        return ()
    names = ", ".join(repeated[:MOST_NAMES]) + (", …" if len(repeated) > MOST_NAMES else "")
    return (f"lines with the same {identity!r} count as one road ({names}); see --id",)


def _text_of(value: object) -> str:
    """Return the value of a column as text; "" for None and NaN."""
    return "" if value is None or value != value else str(value)


def _driven_directions(
    identity: str, name: str, kind: str, oneway: str, points: FloatArray
) -> list[DirectedLink]:
    """Return a link for each direction in which a line may be driven."""
    is_distinct = np.append(True, (np.diff(points, axis=0) != 0.0).any(axis=1))
    points = points[is_distinct[: len(points)]]
    if len(points) < 2:
        return []
    forward = DirectedLink(identity, FORWARD, name, kind, points[:, 0], points[:, 1])
    backward = DirectedLink(identity, BACKWARD, name, kind, points[::-1, 0], points[::-1, 1])
    if oneway.lower() in _ONLY_FORWARD:
        return [forward]
    return [backward] if oneway.lower() in _ONLY_BACKWARD else [forward, backward]
