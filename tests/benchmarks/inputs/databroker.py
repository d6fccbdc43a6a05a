"""Simulated databroker (server of a vehicle's signals): the interface kuksa.val.v2 over gRPC, with
GetValue, Subscribe and PublishValue as specified.

A request for an unknown signal path is answered with NOT_FOUND. A subscription first sends all
known values, and then each update. Updates for a slow subscriber are buffered up to its
`buffer_size`; then the oldest are dropped.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Self

from edge_agent.inputs.live.kuksa import broker_pb2 as messages
from edge_agent.inputs.recording import import_optional
from schemas.thresholds import NS

LONGEST_BUFFER = 1000


class Databroker:
    """gRPC server of signals at the address host:port. It knows the given signal paths, which have
    no values at the start. Values that are one of the words `rejected` get an error, as words do
    that a signal does not allow.
    """

    def __init__(self, address: str, paths: Sequence[str], rejected: Collection[str] = ()) -> None:
        self._rejected = rejected
        self._grpc = import_optional("grpc")
        self._values = {path: messages.Datapoint() for path in paths}
        self._changed = threading.Condition()
        self._subscribers: list[deque[Any]] = []
        self._open = True
        grpc = self._grpc
        self._server = grpc.server(ThreadPoolExecutor(8))
        asked = {
            "GetValue": grpc.unary_unary_rpc_method_handler(
                self._get,
                messages.GetValueRequest.FromString,
                messages.GetValueResponse.SerializeToString,
            ),
            "PublishValue": grpc.unary_unary_rpc_method_handler(
                self._take,
                messages.PublishValueRequest.FromString,
                messages.PublishValueResponse.SerializeToString,
            ),
            "Subscribe": grpc.unary_stream_rpc_method_handler(
                self._subscribe,
                messages.SubscribeRequest.FromString,
                messages.SubscribeResponse.SerializeToString,
            ),
        }
        self._server.add_generic_rpc_handlers(
            (grpc.method_handlers_generic_handler("kuksa.val.v2.VAL", asked),)
        )
        self.port = self._server.add_insecure_port(address)

    def __enter__(self) -> Self:
        self._server.start()
        return self

    def __exit__(self, *_: object) -> None:
        with self._changed:
            self._open = False
            self._changed.notify_all()
        self._server.stop(0.5).wait()

    @property
    def subscribers(self) -> int:
        """Return the number of current subscribers to the broker."""
        return len(self._subscribers)

    def value(self, path: str) -> Any:  # noqa: ANN401
        """Return the data point (value and time stamp) that this simulated broker has stored for a
        path.
        """
        with self._changed:
            return self._values[path]

    def publish(self, values: Mapping[str, float], time_ns: int) -> None:
        """Publish new values by path, all with the time stamp `time_ns` [ns UTC]."""
        update = {}
        for path, value in values.items():
            point = messages.Datapoint(value=messages.Value(double=value))
            point.timestamp.seconds, point.timestamp.nanos = divmod(time_ns, NS)
            update[path] = point
        self._tell(update)

    def _tell(self, update: dict[str, Any]) -> None:
        with self._changed:
            self._values |= update
            for waiting in self._subscribers:
                waiting.append(update)
            self._changed.notify_all()

    def _get(self, request: Any, context: Any) -> Any:  # noqa: ANN401 grpc has no types
        path = request.signal_id.path
        if path not in self._values:
            context.abort(self._grpc.StatusCode.NOT_FOUND, path)
        return messages.GetValueResponse(data_point=self._values[path])

    def _take(self, request: Any, context: Any) -> Any:  # noqa: ANN401
        path = request.signal_id.path
        if path not in self._values:
            context.abort(self._grpc.StatusCode.NOT_FOUND, path)
        if request.data_point.value.string in self._rejected:
            context.abort(self._grpc.StatusCode.INVALID_ARGUMENT, "not an allowed word")
        self._tell({path: request.data_point})
        return messages.PublishValueResponse()

    def _subscribe(self, request: Any, context: Any) -> Iterator[Any]:  # noqa: ANN401
        paths = set(request.signal_paths)
        if not paths or request.buffer_size > LONGEST_BUFFER:
            context.abort(self._grpc.StatusCode.INVALID_ARGUMENT, "no path, or too long a buffer")
        if unknown := paths - self._values.keys():
            context.abort(self._grpc.StatusCode.NOT_FOUND, ", ".join(sorted(unknown)))
        waiting: deque[Any] = deque(maxlen=request.buffer_size + 1)
        with self._changed:
            known = {path: self._values[path] for path in paths}
            self._subscribers.append(waiting)
        yield messages.SubscribeResponse(entries=known)
        try:
            while context.is_active() and self._open:
                with self._changed:
                    if not self._changed.wait_for(lambda: waiting or not self._open, timeout=0.5):
                        continue
                    updates = [waiting.popleft() for _ in range(len(waiting))]
                for update in updates:
                    mine = {path: point for path, point in update.items() if path in paths}
                    if mine:
                        yield messages.SubscribeResponse(entries=mine)
        finally:
            with self._changed:
                self._subscribers.remove(waiting)
