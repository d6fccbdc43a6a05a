"""`python -m tests.faults.flooder`: one enrolled vehicle that sends valid observations as fast as
it can.

It reads one line of JSON: settings, name, cells (cell, latitude, longitude), mu, seconds. It prints
the number of messages that it sent.
"""

from __future__ import annotations

import json
import os
import sys
import time

import zenoh

from schemas import wire
from schemas.config import ZenohSettings
from schemas.proto import gripmap_pb2 as pb
from schemas.runtime.zenoh_session import configuration
from schemas.wire import Kind
from tests.fleet_service.examples import SECOND, batch, key

# Records per message: small messages cost most per byte, large ones most in total.
ROWS = (1, 1, 1, 50)


def main() -> None:
    """Send observations as fast as possible, with the settings and for the time that the line on
    standard input states.
    """
    task = json.loads(sys.stdin.readline())
    name = task["name"]
    cells = task["cells"]
    messages = [
        pb.ObservationBatch.FromString(
            wire.encode(
                batch(
                    name,
                    1,
                    time.time_ns(),
                    [task["mu"]] * rows,
                    cell=[cell] * rows,
                    latitude=[latitude] * rows,
                    longitude=[longitude] * rows,
                )
            )
        )
        for cell, latitude, longitude in cells
        for rows in ROWS
    ]
    session = zenoh.open(configuration(ZenohSettings.model_validate(task["settings"]), name))
    place = key(name)
    encoding = wire.ENCODING[Kind.OBSERVATION]
    block = zenoh.CongestionControl.BLOCK
    print("ready", flush=True)
    end = time.monotonic() + task["seconds"]
    sent = 0
    while time.monotonic() < end:
        message = messages[sent % len(messages)]
        sent += 1
        now = time.time_ns()
        message.seq = sent
        message.leave_time[:] = [now] * len(message.leave_time)
        message.enter_time[:] = [now - SECOND] * len(message.leave_time)
        session.put(place, message.SerializeToString(), encoding=encoding, congestion_control=block)
    print(sent, flush=True)
    os._exit(0)  # a session whose messages are still being read would delay the end of the process


if __name__ == "__main__":
    main()
