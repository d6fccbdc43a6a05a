"""Metrics and health over HTTP: OpenMetrics at `/metrics`, health at `/healthz`, on the loopback
interface by default.

All values are read from the program's state at the time of the request. The module keeps no
counters of its own.
"""

from __future__ import annotations

import errno
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from socket import SHUT_RD, gaierror, socket
from threading import Thread, Timer
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple
from urllib.parse import urlsplit

from schemas.errors import InputError
from schemas.runtime.installing import install_command

if TYPE_CHECKING:
    from prometheus_client.registry import CollectorRegistry

PREFIX: Final = "gripmap_"
READ_S: Final = 5.0  # longest time for receiving a request; then the connection is closed


class Metric(NamedTuple):
    """Metric in OpenMetrics format, with one or several values.

    Attributes:
        name: name without the prefix of this program.
        kind: "counter" (never falls) or "gauge" (rises and falls).
        help: one line of explanation.
        values: number by value of the label. A metric with the label `outcome`, for example, has
            one number per outcome. The only key of a metric without label is "".
        label: name of the OpenMetrics label; "" for a metric without label.
    """

    name: str
    kind: Literal["counter", "gauge"]
    help: str
    values: Mapping[str, float]
    label: str = ""


def gauge(name: str, text: str, value: float) -> Metric:
    """Return a metric with a single value that can rise and fall."""
    return Metric(name, "gauge", text, {"": value})


def counter(name: str, text: str, count: float) -> Metric:
    """Return a metric with a single value that never falls."""
    return Metric(name, "counter", text, {"": count})


Read = Callable[[], Sequence[Metric]]
Troubles = Callable[[], Sequence[str]]


@contextmanager
def serve_metrics(
    host: str, port: int | None, read: Read, troubles: Troubles, field: str = "metrics_port"
) -> Iterator[str | None]:
    """Serve metrics and health until the `with` block ends; yield the address, or None if `port` is
    None. Port 0 selects a free port.

    Args:
        host, port: address to listen on.
        read: function that returns all metrics with their current values.
        troubles: function that returns one message per problem of the program; an empty list means
            that it is healthy.
        field: name of the port's setting or option, for error messages.

    Raises:
        InputError: the port is in use, the host is not an address of this machine, or the
            package for the format is missing.
    """
    if port is None:
        yield None
        return
    handler = type(
        "Handler",
        (_Handler,),
        {"exposition": staticmethod(_make_exposition(read)), "troubles": staticmethod(troubles)},
    )
    try:
        server = _MetricsServer((host, port), handler)
    except OSError as error:
        problem = f"cannot listen on {host}:{port} ({error.strerror})"
        if isinstance(error, gaierror) or error.errno == errno.EADDRNOTAVAIL:
            fix = "give an address of this machine"
            raise InputError("metrics_host", problem, fix) from error
        raise InputError(field, problem, "give another") from error
    server.daemon_threads = True
    thread = Thread(target=server.serve_forever, name="monitor", daemon=True)
    thread.start()
    try:
        yield f"http://{host}:{server.server_address[1]}"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def _make_exposition(read: Read) -> Callable[[], tuple[str, bytes]]:
    try:
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
        from prometheus_client.openmetrics.exposition import CONTENT_TYPE_LATEST, generate_latest
        from prometheus_client.registry import Collector, CollectorRegistry
    except ImportError as error:
        fix = f"{install_command('metrics')}; or leave the port out"
        raise InputError("metrics_port", "the package prometheus-client is missing", fix) from error

    class Values(Collector):
        def collect(self) -> Iterator[CounterMetricFamily | GaugeMetricFamily]:
            for metric in read():
                family = CounterMetricFamily if metric.kind == "counter" else GaugeMetricFamily
                found = family(
                    PREFIX + metric.name, metric.help, labels=[metric.label] if metric.label else []
                )
                for label, value in sorted(metric.values.items()):
                    found.add_metric([label] if metric.label else [], value)
                yield found

    registry: CollectorRegistry = CollectorRegistry()
    registry.register(Values())
    return lambda: (CONTENT_TYPE_LATEST, generate_latest(registry))


class _MetricsServer(ThreadingHTTPServer):
    # The base class declares these types.
    def finish_request(self, request: Any, client_address: Any) -> None:  # noqa: ANN401
        deadline = Timer(READ_S, _stop_reading, (request,))
        deadline.daemon = True
        deadline.start()
        try:
            super().finish_request(request, client_address)
        finally:
            deadline.cancel()


def _stop_reading(connection: socket) -> None:
    with suppress(OSError):  # the connection has just been closed
        connection.shutdown(SHUT_RD)


class _Handler(BaseHTTPRequestHandler):
    exposition: Callable[[], tuple[str, bytes]]
    troubles: Troubles
    timeout = READ_S
    server_version = "gripmap"
    sys_version = ""

    def do_GET(self) -> None:
        if not self._is_own_name():
            self._send(421, "text/plain", b"this service is not known under that name\n")
            return
        path = self.path.partition("?")[0]
        if path == "/metrics":
            self._send(200, *self.exposition())
        elif path == "/healthz":
            troubles = list(self.troubles())
            state = {"status": "trouble" if troubles else "ok", "troubles": troubles}
            self._send(503 if troubles else 200, "application/json", json.dumps(state).encode())
        else:
            self._send(404, "text/plain", b"/metrics and /healthz\n")

    def _is_own_name(self) -> bool:
        """Return True if the host name in the HTTP request is allowed. A server on the loopback
        interface refuses any other host name, because otherwise a web page could read the metrics
        by DNS rebinding.
        """
        server = self.server
        try:
            host = urlsplit(f"//{self.headers.get('Host', '')}").hostname
        except ValueError:
            return False
        is_local = isinstance(server, ThreadingHTTPServer) and server.server_address[0] in (
            "127.0.0.1",
            "::1",
        )
        return not is_local or host in (None, "localhost", "127.0.0.1", "::1")

    def _send(self, status: int, form: str, body: bytes) -> None:
        self.send_response(status)
        self.send_header("Content-Type", form)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("X-Content-Type-Options", "nosniff")
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002
        """Do nothing, so that HTTP requests are not logged."""
