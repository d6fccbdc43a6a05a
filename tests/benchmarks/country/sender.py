"""Sender of the country's vehicles: a process that sends their reports, and records how long each
batch waited for its acknowledgement.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Final

import numpy as np
import zenoh

from schemas import keys, wire
from schemas.config import ZenohSettings
from schemas.runtime.zenoh_session import open_session
from schemas.wire import Kind
from tests.benchmarks.country.replayed import PERIOD_S, ROWS, Country

EVERY_S: Final = 10.0  # time between two printed lines
PATIENCE_S: Final = 30.0  # wait for the remaining acknowledgements
_BLOCK: Final = zenoh.CongestionControl.BLOCK


class Waits:
    """Times [s] at which each vehicle's batches were sent and acknowledged: two arrays of shape
    (turns, vehicles), where a turn is one batch per vehicle. NaN means not yet.
    """

    def __init__(self, session: zenoh.Session, vehicles: int, turns: int) -> None:
        self.put, self.acked = np.full((2, turns, vehicles), np.nan)
        self._subscriber = session.declare_subscriber(keys.ack_key("*"), self._record_ack)

    def _record_ack(self, sample: zenoh.Sample) -> None:
        now = time.monotonic()
        name, streams = wire.decode_ack(sample.payload.to_bytes())
        vehicle = int(name.partition("-")[2])
        for stream in streams:
            for first, last in stream.durable:
                self.acked[first - 1 : last, vehicle] = now

    def summarize(self, since: float) -> dict[str, float]:
        """Return by name the number of sent batches, the number of acknowledged ones, and the
        longest time [s] for which a batch waits now. Return also the 99 % quantile [s] of the waits
        of the acknowledged batches that were sent after `since`.
        """
        # Zenoh's callback changes `acked` meanwhile, so a copy is used.
        put = self.put
        acked = self.acked.copy()
        now = time.monotonic()
        waits = np.isfinite(put) & np.isnan(acked)
        ended = (acked - put)[(put >= since) & np.isfinite(acked)]
        return {
            "put": float(np.isfinite(put).sum()),
            "acked": float(np.isfinite(acked).sum()),
            "oldest_s": float(now - put[waits].min()) if waits.any() else 0.0,
            "p99_s": float(np.quantile(ended, 0.99)) if len(ended) else float("nan"),
        }


def main() -> int:
    """Send the reports of all vehicles for the time that the command line states, and wait for the
    last acknowledgements. Write the waiting times of the batches, and return the exit code.
    """
    parser = argparse.ArgumentParser(prog="sender")
    parser.add_argument("endpoint")
    parser.add_argument("city", type=Path, help="folder of the city's observations")
    parser.add_argument("out", type=Path, help="file for the waits")
    parser.add_argument("--seconds", type=float, required=True)
    parser.add_argument("--vehicles", type=int, required=True)
    parser.add_argument("--seed", type=int, required=True)
    asked = parser.parse_args()
    country = Country(asked.city, asked.seed, asked.vehicles)
    session = open_session(ZenohSettings(connect=[asked.endpoint]))
    assert session is not None
    turns = int(asked.seconds / PERIOD_S) + 1
    waits = Waits(session, asked.vehicles, turns)
    boot = time.time_ns()
    rate = asked.vehicles / PERIOD_S
    encoding = wire.ENCODING[Kind.OBSERVATION]
    began = time.monotonic()
    last_printed = began
    late = 0.0
    for number in range(int(asked.seconds * rate)):
        due = began + number / rate
        # Shorter waits are skipped; then several batches are sent at once.
        if (ahead := due - time.monotonic()) > 0.002:
            time.sleep(ahead)
        late = max(late, -ahead)
        turn, vehicle = divmod(number, asked.vehicles)
        key, payload = country.encode_report(vehicle, turn, boot)
        waits.put[turn, vehicle] = time.monotonic()
        session.put(key, payload, encoding=encoding, congestion_control=_BLOCK)
        if time.monotonic() - last_printed >= EVERY_S:
            line = waits.summarize(last_printed) | {"late_s": late, "payload": float(len(payload))}
            print(json.dumps(line), flush=True)
            last_printed = time.monotonic()
            late = 0.0
    deadline = time.monotonic() + PATIENCE_S
    while (
        left := np.isfinite(waits.put) & np.isnan(waits.acked)
    ).any() and time.monotonic() < deadline:
        time.sleep(0.05)
    np.savez(asked.out, put=waits.put - began, wait=waits.acked - waits.put, region=country.region)
    print(
        json.dumps(
            {
                "unacknowledged": int(left.sum()),
                "observations": int(np.isfinite(waits.put).sum()) * ROWS,
            }
        )
    )
    session.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
