"""Friction at the vehicle as signals of the Vehicle Signal Specification (COVESA VSS 4 and later).

`Vehicle.ADAS.ESC.RoadFriction.{MostProbable,LowerBound,UpperBound}` are percent of a peak adhesion
of 1: 50 %, 5 % and 95 % quantiles, limited to 100 as the standard requires. Unknown signals are
left out, never replaced by a default. MostProbable is also left out if less than EXCITED_SHARE of
the grip was used within UTILISED_WINDOW_S, because the estimate then depends mostly on the prior.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any, Final, Protocol

import zenoh

from edge_agent.observe.pipeline import Grip
from schemas import keys
from schemas.runtime.zenoh_session import quality_of
from schemas.thresholds import EXCITED_SHARE, NS

BRANCH: Final = "Vehicle.ADAS.ESC.RoadFriction"
ENCODING: Final = "application/json"
FULL: Final = 100.0  # [%] largest value of a friction signal
DIGITS: Final = 1
_TOPIC: Final = keys.TOPICS["vss"]


def road_friction(
    mu: float, mu_lower: float, mu_upper: float, mu_utilised: float
) -> dict[str, float]:
    """Return the known friction signals [%] as a dictionary indexed by VSS path; it is empty if no
    signal is known.

    Args:
        mu, mu_lower, mu_upper: 50 %, 5 % and 95 % quantiles of the friction; NaN where unknown.
        mu_utilised: largest grip (force over load) used by any wheel in the last second.
    """
    signals = {
        "MostProbable": mu if mu_utilised >= EXCITED_SHARE * mu else math.nan,
        "LowerBound": mu_lower,
        "UpperBound": mu_upper,
    }
    return {
        f"{BRANCH}.{name}": round(min(FULL * value, FULL), DIGITS)
        for name, value in signals.items()
        if math.isfinite(value)
    }


class SignalProvider(Protocol):
    """Interface of a component that passes the friction signals of a vehicle on, for example to a
    signal server.
    """

    def write(self, signals: Mapping[str, float], time_ns: int) -> None:
        """Accept the `signals` [%], indexed by VSS path, and their time [ns UTC] for sending. The
        call must not wait.
        """

    def close(self) -> None:
        """Send the signals that still wait for sending, and stop the provider."""


class RoadFrictionOutput:
    """Output of the friction of the vehicles `names`: one JSON line per vehicle on the terminal,
    and the same line on the vehicle's Zenoh key.

    Args:
        names: names of the vehicles; row k of the reported values belongs to vehicle k.
        print_line: function that prints a line.
        rate_hz: reports per second.
        provider: additional receiver of the same signals, if given.
    """

    def __init__(
        self,
        names: Sequence[str],
        print_line: Callable[[str], None],
        rate_hz: float,
        provider: SignalProvider | None = None,
    ) -> None:
        self._names = names
        self._print_line = print_line
        self._provider = provider
        self._step_ns = round(NS / rate_hz)
        self.publishers: dict[str, Any] = {}
        self._due = 0

    def attach(self, name: str, session: zenoh.Session) -> None:
        """Open a publisher of the friction signals on the Zenoh session of the vehicle `name`.
        Later reports are also sent there.
        """
        self.publishers[name] = session.declare_publisher(
            keys.vss_key(name), encoding=ENCODING, **quality_of(_TOPIC)
        )

    def report_grip(self, grip: Grip | None) -> None:
        """Print and publish the current friction of all vehicles if a report is due. The call never
        waits: a message for which there is no space is dropped.
        """
        if grip is None or int(grip.time.max()) < self._due:
            return
        now = int(grip.time.max())
        self._due = now + self._step_ns
        for k, name in enumerate(self._names):
            known = road_friction(*(float(column[k]) for column in grip[:4]))
            at = datetime.fromtimestamp(int(grip.time[k]) / NS, UTC).isoformat(
                timespec="milliseconds"
            )
            line = json.dumps(
                {"event": "vss", "vehicle": name, "time": at.replace("+00:00", "Z"), **known}
            )
            self._print_line(line)
            if self._provider is not None:
                self._provider.write(known, int(grip.time[k]))
            publisher = self.publishers.get(name)
            if publisher is not None and publisher.matching_status.matching:
                publisher.put(line.encode())

    def close(self) -> None:
        """Close the additional receiver of the signals (`provider`), if there is one."""
        if self._provider is not None:
            self._provider.close()
