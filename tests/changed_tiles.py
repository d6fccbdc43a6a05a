"""Helper of tests that read the tiles which a service would publish."""

from __future__ import annotations

from fleet_service.app.queries import Queries


def changed_tiles(queries: Queries, now: int) -> list[tuple[int, bytes]]:
    """Return the tile number and the payload of every non-empty tile that changed since the last
    call.
    """
    changed = queries.take_changed(now)
    return [(tile, stream) for tile in changed if (stream := queries.tile(tile, now))]
