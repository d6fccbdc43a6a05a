"""Tests of the states of the services that the page shows. A service that does not answer in HTTP
must not hide the others.
"""

from __future__ import annotations

import socket
import threading

import pytest

from fleet_service.page.health import ServiceHealth


def test_address_without_http_counts_as_not_answering() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:

        def reply() -> None:
            connection, _ = server.accept()
            with connection:
                connection.recv(1024)
                connection.sendall(b"no HTTP\r\n\r\n")

        thread = threading.Thread(target=reply)
        thread.start()
        address = f"http://127.0.0.1:{server.getsockname()[1]}"
        assert ServiceHealth([address]).services() == [{"address": address, "answers": False}]
        thread.join()


@pytest.mark.parametrize("ending", ["", "/", "/metrics"])
def test_an_address_may_end_with_the_path_of_the_metrics(ending: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        requests = []

        def reply() -> None:
            connection, _ = server.accept()
            with connection:
                requests.append(connection.recv(1024))
                connection.sendall(b"HTTP/1.0 200 OK\r\n\r\n")

        thread = threading.Thread(target=reply)
        thread.start()
        address = f"http://127.0.0.1:{server.getsockname()[1]}{ending}"
        assert ServiceHealth([address]).services()[0]["answers"]
        thread.join()
        assert requests[0].startswith(b"GET /metrics ")
