"""Two or three services that take over from each other: real processes, a real S3 server, and
network links that can be cut.
"""

from __future__ import annotations

import json
import signal
import socket
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from fleet_service.replication.replica import BucketReplica
from tests.buckets import BucketServer
from tests.faults.processes import Part


class Link:
    """Port that forwards to another port of this machine. While the link is cut, the port accepts
    connections and forwards nothing.
    """

    def __init__(self, port: int) -> None:
        self._to = port
        self._open = threading.Event()
        self._open.set()
        self._server = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._server.getsockname()[1])
        self._ends: list[socket.socket] = []
        threading.Thread(target=self._accept_connections, daemon=True).start()

    def cut(self) -> None:
        """Cut the link: forward nothing until `restore` is called."""
        self._open.clear()

    @property
    def is_cut(self) -> bool:
        """Return True if the link is cut."""
        return not self._open.is_set()

    def restore(self) -> None:
        """Restore the link: forward the waiting and all later traffic."""
        self._open.set()

    def close(self) -> None:
        """Close the port and all its connections."""
        for end in [self._server, *self._ends]:
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.close()
        self._open.set()

    def _accept_connections(self) -> None:
        with suppress(OSError):
            while True:
                near, _ = self._server.accept()
                try:
                    far = socket.create_connection(("127.0.0.1", self._to), 5.0)
                except OSError:
                    near.close()
                    continue
                far.settimeout(None)
                self._ends += [near, far]
                for ends in ((near, far), (far, near)):
                    threading.Thread(target=self._forward, args=ends, daemon=True).start()

    def _forward(self, source: socket.socket, sink: socket.socket) -> None:
        with suppress(OSError):
            while data := source.recv(1 << 16):
                self._open.wait()
                sink.sendall(data)
        with suppress(OSError):
            sink.shutdown(socket.SHUT_WR)


class Host:
    """Simulated machine: a service, its link to the router and its link to the bucket."""

    def __init__(
        self,
        folder: Path,
        router: str,
        bucket: BucketServer,
        module: str = "fleet_service.cli",
        **settings: Any,  # noqa: ANN401
    ) -> None:
        folder.mkdir(parents=True)
        self.root = folder / "archive"
        self.to_router = Link(int(router.rpartition(":")[2]))
        self.to_bucket = Link(int(bucket.store["endpoint"].rpartition(":")[2]))
        store = {**bucket.store, "endpoint": f"http://127.0.0.1:{self.to_bucket.port}"}
        document = {
            "zenoh": {"connect": [f"tcp/127.0.0.1:{self.to_router.port}"]},
            "standby": True,
            "segment_s": 0.1,
            "archive": {"path": str(self.root), "copy": bucket.url, "store": store},
            **settings,
        }
        config = folder / "service.json"
        config.write_text(json.dumps(document))
        words = ["-m", module, "run", "--config", str(config)]
        self.part = Part("service", [sys.executable, *words], folder)

    def has_said(self, start: str) -> bool:
        """Return True if the service has printed a line beginning with this text since its last
        start.
        """
        return any(line.startswith(start) for line in self.part.read_lines())

    def close(self) -> None:
        """Kill the service if it is still running, and close its links to router and bucket."""
        self.to_router.close()
        self.to_bucket.close()
        self.part.send_signal(signal.SIGCONT)
        self.part.kill()


@contextmanager
def open_hosts(
    folder: Path,
    names: Sequence[str],
    router: str,
    bucket: BucketServer,
    *,
    named: bool = False,
    **settings: Any,  # noqa: ANN401
) -> Iterator[list[Host]]:
    """Yield hosts (simulated machines) whose services are not yet started, and close them after the
    `with` block. If `named`, each service has its host's name.
    """
    with ExitStack() as stack:
        own = [{"name": name} if named else {} for name in names]
        made = [
            Host(folder / name, router, bucket, **settings, **one)
            for name, one in zip(names, own, strict=True)
        ]
        for host in made:
            stack.callback(host.close)
        yield made


def restore_archive(folder: Path, bucket: BucketServer) -> Path:
    """Restore the archive from the bucket into `folder`, as a service with an empty disk does, and
    return its path. The bucket is not changed.
    """
    root = folder / "archive"
    root.mkdir(parents=True)
    copy = BucketReplica(root, bucket.url, bucket.store)
    try:
        copy.prefetch()
    finally:
        copy.close()
    return root
