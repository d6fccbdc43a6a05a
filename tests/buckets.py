"""Real S3 server in a separate process, which a test can stop, freeze and restart."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tests.ports import free_ports
from tests.waiting import freeze, until

BUCKET = "grip"
PREFIX = "north/map"
SECRET = "not-to-be-read"


class BucketServer:
    """S3 server that stores its objects in a folder, so that they remain after a restart."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        (folder / BUCKET).mkdir(parents=True)
        (self._port,) = free_ports(1)
        self._process: subprocess.Popen[bytes] | None = None
        self.url = f"s3://{BUCKET}/{PREFIX}"
        self.store = {
            "endpoint": f"http://127.0.0.1:{self._port}",
            "region": "eu-north-1",
            "disable_bulk_delete": "true",
            "access_key_id": "tester",
            "secret_access_key": SECRET,
        }

    @property
    def settings(self) -> dict[str, Any]:
        """Return the entries of a service's configuration that name this server's bucket."""
        return {"copy": self.url, "store": self.store}

    def start(self) -> None:
        """Start the S3 server, and return when it accepts connections."""
        words = ["-m", "localbucket", str(self._folder), "--port", str(self._port)]
        quiet = subprocess.DEVNULL
        self._process = subprocess.Popen([sys.executable, *words], stdout=quiet, stderr=quiet)
        until(self._is_up)

    def stop(self) -> None:
        """Stop the S3 server, so that connections are refused."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None

    def take_away(self, how: str) -> None:
        """Make the server unavailable. If `how` is "stopped", the process ends. If it is "frozen",
        the server accepts connections but does not answer.
        """
        if how == "stopped":
            self.stop()
        else:
            assert self._process is not None
            freeze(self._process)

    def bring_back(self, how: str) -> None:
        """Make the server available again after a call of `take_away`. `how` ("stopped" or
        "frozen") must be the same as in that call.
        """
        if how == "stopped":
            self.start()
        else:
            assert self._process is not None
            self._process.send_signal(signal.SIGCONT)

    def read_objects(self) -> dict[str, bytes]:
        """Return the content of every object in the bucket, by object name."""
        base = self._folder / BUCKET / PREFIX
        found = [
            path for path in base.rglob("*") if path.is_file() and not path.name.startswith(".")
        ]
        return {path.relative_to(base).as_posix(): path.read_bytes() for path in found}

    def path_of(self, name: str) -> Path:
        """Return the path of the file in which the server stores an object."""
        return self._folder / BUCKET / PREFIX / name

    def _is_up(self) -> bool:
        try:
            socket.create_connection(("127.0.0.1", self._port), 1.0).close()
        except OSError:
            return False
        return True


@contextmanager
def bucket_server(folder: Path) -> Iterator[BucketServer]:
    """Yield a running S3 server for the duration of the `with` block."""
    made = BucketServer(folder)
    made.start()
    try:
        yield made
    finally:
        made.stop()


def list_copied_files(root: Path) -> dict[str, bytes]:
    """Return, by path, the content of those files of an archive that its bucket copy must
    contain.
    """
    from fleet_service.replication.replica_files import FOLDERS

    paths = [path for name in FOLDERS for path in (root / name).rglob("*") if path.is_file()]
    return {
        path.relative_to(root).as_posix(): path.read_bytes()
        for path in paths
        if path.name != "tried" and not path.name.startswith(".") and path.suffix != ".bad"
    }
