"""Provider for a Kuksa databroker: writes the friction at the vehicle over kuksa.val.v2.

The signals `Vehicle.ADAS.ESC.RoadFriction.*` are floats in percent. The signal
`Vehicle.Exterior.RoadSurfaceCondition` (VSS pull request 892) is a word such as "ICE". If a value
is unknown, a data point without a value is written. Without this data point the broker would
continue to show the outdated value.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Mapping
from typing import Any, Final
from urllib.parse import parse_qsl

from edge_agent.inputs.live.kuksa.connection import FILES, PORT, BrokerConnection, describe_error
from edge_agent.publish.vss import BRANCH
from schemas.errors import InputError
from schemas.thresholds import NS

FRICTION: Final = tuple(f"{BRANCH}.{name}" for name in ("MostProbable", "LowerBound", "UpperBound"))
CONDITION: Final = "Vehicle.Exterior.RoadSurfaceCondition"
# Only ice and a dry road can be recognised by friction. Packed snow has at least 20 %, and wet
# asphalt at most 80 % (Pacejka 2012, ch. 1). Between the limits, several conditions are possible.
ICE_BELOW: Final = 20.0  # [%] limit for the upper bound of friction
DRY_ABOVE: Final = 80.0  # [%] limit for the lower bound of friction
WRITE_S: Final = 2.0  # [s] timeout for writing one value
LEAVE_S: Final = 5.0  # [s] time to wait for the thread at the end

log = logging.getLogger(__name__)


def surface_condition(signals: Mapping[str, float]) -> str:
    """Return the value of RoadSurfaceCondition: "ICE" if the upper friction bound in `signals` is
    low, "DRY" if the lower bound is high, else "UNKNOWN".
    """
    if signals.get(f"{BRANCH}.UpperBound", 100.0) < ICE_BELOW:
        return "ICE"
    return "DRY" if signals.get(f"{BRANCH}.LowerBound", 0.0) > DRY_ABOVE else "UNKNOWN"


class KuksaProvider:
    """Writer of one vehicle's VSS friction signals to a Kuksa databroker. It writes on a separate
    thread, so that an unavailable broker does not delay the agent.

    Attributes:
        written: number of values that the broker accepted.
        refused: number of values that the broker rejected.

    Args:
        text: HOST:PORT, with `?ca=FILE` for TLS and `&token=FILE` for a JSON web token.

    Raises:
        InputError: `text` is not an address, grpc is not installed, or a file cannot be read.
    """

    def __init__(self, text: str) -> None:
        address, _, query = text.partition("?")
        files = dict(parse_qsl(query))
        host, _, port = address.partition(":")
        if not host or not set(files) <= set(FILES):
            fix = f"write it like 127.0.0.1:{PORT}?ca=ca.pem&token=agent.jwt"
            raise InputError("kuksa", f"{text!r} is not the address of a databroker", fix)
        self.written = 0
        self.refused = 0
        self._connection = BrokerConnection(text, f"{host}:{port or PORT}", files)
        self._unknown_paths: set[str] = set()
        self._rejecting_paths: set[str] = set()  # paths of which the broker rejected a value
        self._problem = ""
        self._latest: tuple[Mapping[str, float], int] | None = None
        self._changed = threading.Condition()
        self._stopping = False
        self._thread = threading.Thread(target=self._publish_loop, name="kuksa", daemon=True)
        self._thread.start()

    def write(self, signals: Mapping[str, float], time_ns: int) -> None:
        """Queue VSS signals (values [%] by signal path) that are valid at `time_ns` [ns UTC]. They
        replace earlier values that have not been written yet.
        """
        with self._changed:
            self._latest = (signals, time_ns)
            self._changed.notify()

    def close(self) -> None:
        """Write the waiting signals, and stop the thread."""
        with self._changed:
            self._stopping = True
            self._changed.notify()
        self._thread.join(LEAVE_S)

    def _publish_loop(self) -> None:
        connection = self._connection
        with connection.open_channel() as channel:
            answer = connection.messages.PublishValueResponse
            publish = connection.make_call(channel.unary_unary, "PublishValue", answer)
            while True:
                with self._changed:
                    self._changed.wait_for(lambda: self._latest is not None or self._stopping)
                    latest = self._latest
                    self._latest = None
                if latest is None:
                    return
                try:
                    self._write_all(publish, *latest)
                # The library may raise any error, which must not end this thread.
                except Exception as error:  # noqa: BLE001
                    self._log_problem(str(error) or type(error).__name__)

    def _write_all(
        self,
        publish: Any,  # noqa: ANN401
        signals: Mapping[str, float],
        time_ns: int,
    ) -> None:
        messages = self._connection.messages
        values: dict[str, Any] = {
            path: messages.Value(float=signals[path]) if path in signals else None
            for path in FRICTION
        }
        values[CONDITION] = messages.Value(string=surface_condition(signals))
        for path, value in values.items():
            if path not in self._unknown_paths and not self._write_one(
                publish, path, value, time_ns
            ):
                return

    def _write_one(self, publish: Any, path: str, value: Any, time_ns: int) -> bool:  # noqa: ANN401
        """Write one value to the databroker at the VSS path `path`. If the broker rejects the
        value, write that it is unknown, so that the broker does not keep the previous value. Return
        False only if the broker is unavailable.
        """
        messages = self._connection.messages
        point = messages.Datapoint(value=value)
        point.timestamp.seconds, point.timestamp.nanos = divmod(time_ns, NS)
        request = messages.PublishValueRequest(
            signal_id=messages.SignalID(path=path), data_point=point
        )
        grpc = self._connection.grpc
        try:
            publish(request, timeout=WRITE_S, metadata=self._connection.metadata)
        except grpc.RpcError as error:
            code = error.code()
            is_rejected = code == grpc.StatusCode.INVALID_ARGUMENT
            if code == grpc.StatusCode.NOT_FOUND:
                self._unknown_paths.add(path)
                log.warning("the databroker does not know %s: %s", path, error.details())
            elif not is_rejected:
                self._log_problem(describe_error(error))
            elif path not in self._rejecting_paths:
                self._rejecting_paths.add(path)
                log.warning("the databroker rejects a value of %s: %s", path, error.details())
            # Count after writing the log line, so that the line exists when the count is visible.
            self.refused += 1
            if is_rejected and value is not None:
                return self._write_one(publish, path, None, time_ns)
            return code not in (grpc.StatusCode.UNAVAILABLE, grpc.StatusCode.DEADLINE_EXCEEDED)
        self._log_problem("")
        self.written += 1
        return True

    def _log_problem(self, problem: str) -> None:
        """Log a problem with the databroker when it begins and when it ends."""
        if problem and not self._problem:
            log.warning("writing to the databroker fails (%s); trying again", problem)
        elif self._problem and not problem:
            log.warning("writing to the databroker works again")
        self._problem = problem
