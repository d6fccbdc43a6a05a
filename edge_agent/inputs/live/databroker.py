"""Live source for a Kuksa databroker, by gRPC (kuksa.val.v2). Signals are paths of the vehicle
signal specification (COVESA VSS).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

import numpy as np

from edge_agent.inputs.live.feed import Feed, HostClock, Received
from edge_agent.inputs.live.kuksa.connection import BrokerConnection, describe_error
from edge_agent.inputs.recording import Series
from schemas.thresholds import NS

# Updates that the broker buffers for a slow subscriber: the largest number that it accepts.
BUFFER: Final = 1000
ASK_S: Final = 5.0  # [s] timeout of a call
NUMBERS: Final = ("bool", "int32", "int64", "uint32", "uint64", "float", "double")


class DatabrokerFeed(Feed):
    """Live source for the signals of a Kuksa databroker; a signal is named by its VSS path.

    Args:
        name: name of the source.
        clock: clock of the host.
        address: host and port.
        paths: paths of the needed signals; paths that the broker does not know are left out.
        lasting: those of the paths that are sent only when they change.
        files: `ca`, file of the certificate authority (without it the connection does not use TLS),
            and `token`, file with a JSON web token.

    Raises:
        InputError: grpc is not installed, or a file cannot be read.
    """

    def __init__(
        self,
        name: str,
        clock: HostClock,
        address: str,
        paths: Sequence[str],
        files: Mapping[str, str],
        lasting: Iterable[str] = (),
    ) -> None:
        super().__init__(name, clock)
        self._connection = BrokerConnection(name, address, files)
        self._messages = self._connection.messages
        self._paths = sorted(paths)
        self._lasting = frozenset(lasting)
        self._call: Any = None

    def listen(self) -> None:
        """Receive updates until the connection to the broker ends.

        The first answer contains the broker's last values, which may be old. They do not count as
        readings, except for a signal that is sent only when it changes: its last value is still
        valid.
        """
        connection = self._connection
        with connection.open_channel() as channel:
            known = self._known_paths(channel)
            if not known:
                raise ConnectionError("it has none of the profile's signals")
            m = self._messages
            self._call = connection.make_call(
                channel.unary_stream, "Subscribe", m.SubscribeResponse
            )(
                m.SubscribeRequest(signal_paths=known, buffer_size=BUFFER),
                metadata=connection.metadata,
            )
            try:
                for place, update in enumerate(self._call):
                    is_first = place == 0  # the first update has the present values
                    if is_first:
                        self.openings += 1
                    self._store_update(update, standing=is_first)
                    if self.stopping.is_set():
                        return
            except connection.grpc.RpcError as error:
                raise ConnectionError(describe_error(error)) from None
            finally:
                self._call.cancel()

    def close(self) -> None:
        """Stop listening to the databroker, and cancel the subscription."""
        self.stopping.set()
        if self._call is not None:
            self._call.cancel()
        super().close()

    def series(self, received: list[Received]) -> dict[str, Series]:
        """Return the values from the databroker's updates `received`, by signal path."""
        times: dict[str, list[float]] = {}
        values: dict[str, list[float]] = {}
        for time, (path, value) in received:
            times.setdefault(path, []).append(time)
            values.setdefault(path, []).append(value)
        return {path: Series(np.array(times[path]), np.array(values[path])) for path in times}

    def _known_paths(self, channel: Any) -> list[str]:  # noqa: ANN401
        """Return the source's signal paths that the broker knows. The broker would reject a whole
        subscription that contains an unknown path.
        """
        m = self._messages
        connection = self._connection
        ask = connection.make_call(channel.unary_unary, "GetValue", m.GetValueResponse)
        known = []
        for path in self._paths:
            try:
                request = m.GetValueRequest(signal_id=m.SignalID(path=path))
                ask(request, timeout=ASK_S, metadata=connection.metadata, wait_for_ready=False)
                known.append(path)
            except connection.grpc.RpcError as error:
                if error.code() != connection.grpc.StatusCode.NOT_FOUND:
                    raise ConnectionError(describe_error(error)) from None
                self.log_problem(f"has no signal {path}")
        return known

    def _store_update(self, update: Any, *, standing: bool) -> None:  # noqa: ANN401
        for path, point in update.entries.items():
            kind = point.value.WhichOneof("typed_value")
            if kind in NUMBERS and (not standing or path in self._lasting):
                stamp = point.timestamp
                at = stamp.seconds * NS + stamp.nanos
                if standing:
                    at = self.clock.start_ns + round(self.clock.now() * NS)
                self.store_message(at, (path, float(getattr(point.value, kind))))
