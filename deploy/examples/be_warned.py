"""Example: warnings in a car. The car receives the map of the road ahead over its own session, and
a callback receives each warning.

python deploy/examples/be_warned.py tcp/127.0.0.1:7447 57.7 11.97
"""

from __future__ import annotations

import queue
import sys
import time

import zenoh

import edge_agent

SPEED = 14.0  # [m/s] speed of the car


def main(
    endpoint: str, latitude: float, longitude: float, yaw: float = 0.0, within_s: float = 60.0
) -> str:
    """Receive the map of the road ahead of a position from the router `endpoint`, and print each
    warning. Return the text of the first warning, or "" if there was none within `within_s` [s].
    `latitude` and `longitude` are in degrees, `yaw` is in radians from east.
    """
    warnings: queue.Queue[str] = queue.Queue()
    lookout = edge_agent.Lookout(
        ["my-car"], lambda name, warning: warnings.put(f"{name}: {warning.line()}")
    )
    config = zenoh.Config.from_json5(
        f'{{"mode": "client", "connect": {{"endpoints": ["{endpoint}"]}}}}'
    )
    with zenoh.open(config) as session:
        lookout.attach("my-car", session)
        lookout.start()
        warned = ""
        until = time.monotonic() + within_s
        while not warned and time.monotonic() < until:
            # Report the car's current position.
            lookout.set_poses([edge_agent.Pose(latitude, longitude, yaw, SPEED, time.time_ns())])
            try:
                warned = warnings.get(timeout=0.1)
            except queue.Empty:
                continue
        outlook = lookout.latest_outlook("my-car")
        lookout.close()
    if outlook is not None:
        known = int((outlook.runs.basis > 0).sum())
        print(f"ahead on {outlook.way}: {known} of {len(outlook.runs.basis)} stretches are known")
    print(warned or "no slippery road is known ahead")
    return warned


if __name__ == "__main__":
    if len(sys.argv) < 4:
        sys.exit(
            "usage: python deploy/examples/be_warned.py ENDPOINT LATITUDE LONGITUDE [YAW [SECONDS]]"
        )
    main(sys.argv[1], *map(float, sys.argv[2:]))
