"""Tests of `free_ports`. The returned ports must be unused, and lie below the system's port range
for outgoing connections.
"""

import socket
from pathlib import Path

import pytest

from tests import ports


def test_ports_lie_below_those_of_outgoing_connections() -> None:
    found = ports.free_ports(20)
    assert len(set(found)) == 20
    assert all(ports.FIRST <= port < ports.USUAL_OUTGOING for port in found)
    for port in found:
        with socket.create_server(("127.0.0.1", port)):
            pass


def test_port_in_use_is_not_returned(monkeypatch: pytest.MonkeyPatch) -> None:
    (first,) = ports.free_ports(1)
    monkeypatch.setattr(ports, "FIRST", first)
    monkeypatch.setattr(ports, "USUAL_OUTGOING", first + 1)
    monkeypatch.setattr(ports, "OUTGOING", Path("absent"))
    with socket.create_server(("127.0.0.1", first)), pytest.raises(OSError, match="no 1 free port"):
        ports.free_ports(1)
