"""Client of the map without GripMap code: it needs only Zenoh and the standard library.

python -m deploy.demo.plain_client ENDPOINT WEST,SOUTH,EAST,NORTH
"""

import json
import sys

import zenoh


def main() -> int:
    """Query the map of a rectangular area as GeoJSON and print its first cells."""
    endpoint, bbox = sys.argv[1:3]
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config) as session:
        for reply in session.get(f"gripmap/v1/map/**?bbox={bbox};min_vehicles=2;format=geojson"):
            if reply.ok is None:
                print(reply.err.payload.to_string() if reply.err else "no answer", file=sys.stderr)
                return 1
            features = json.loads(reply.ok.payload.to_string())["features"]
            print(
                f"{reply.ok.key_expr} ({reply.ok.encoding}): {len(features)} cells, the first one:"
            )
            print(json.dumps(features[0]["properties"]) if features else "none")
    return 0


if __name__ == "__main__":
    sys.exit(main())
