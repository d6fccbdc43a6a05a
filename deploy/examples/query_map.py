"""Example: query the map as a table, and decode one tile without GripMap code, as a client in any
language can do.

python deploy/examples/query_map.py tcp/127.0.0.1:7447
"""

from __future__ import annotations

import sys

import zenoh

import fleet_service


def main(endpoint: str) -> int:
    """Query the map through the router `endpoint`, and print its cells, those with the lowest
    friction first. Return the number of cells.
    """
    cells = fleet_service.ask_map(endpoint, min_vehicles=1).to_pandas()
    # For the other cells only a lower bound is known, and their mu is null.
    measured = cells[cells["basis"] == "measured"]
    columns = [
        "latitude",
        "longitude",
        "sector",
        "mu",
        "mu_lower",
        "mu_upper",
        "p_slippery",
        "vehicles",
    ]
    print(
        measured.sort_values("p_slippery", ascending=False)[columns].head().to_string(index=False)
    )

    config = zenoh.Config.from_json5(
        f'{{"mode": "client", "connect": {{"endpoints": ["{endpoint}"]}}}}'
    )
    with zenoh.open(config) as session:
        for reply in session.get("gripmap/v1/map/**"):
            if reply.ok is not None:
                tile = fleet_service.decode_tile(reply.ok.payload.to_bytes())
                print(f"{reply.ok.key_expr}: {tile.num_rows} cells")
    return len(cells)


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "tcp/127.0.0.1:7447")
