"""Tests of the states of the services that the page shows. A service that does not answer in HTTP
must not hide the others.
"""

from __future__ import annotations

import socket
import threading

from fleet_service.page.health import ServiceHealth


def test_an_address_that_does_not_speak_http_does_not_answer() -> None:
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
