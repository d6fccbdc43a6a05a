"""Helper of tests that read the tiles which a service would publish."""

from __future__ import annotations

from fleet_service.app.queries import Queries


def changed_tiles(queries: Queries, now: int) -> list[tuple[int, bytes]]:
    """Return tile number and payload of every non-empty tile that changed since the last call;
    `now` is the present time [ns].
    """
    changed = queries.take_changed(now)
    found: dict[int, bytes] = {}
    while changed:
        made = queries.first_tiles(changed, now)
        found |= made
        changed = changed[len(made) :]
    return [(tile, stream) for tile, stream in found.items() if stream]
