"""Identity of an archive's folder as the holder of a lease (ownership of the bucket copy).

ARCHIVE/holder.json     identity, and the place (bucket, host and folder) to which it belongs
"""

from __future__ import annotations

import json
import secrets
import socket
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from fleet_service.archive.format import layout
from schemas.runtime.durable import open_durably

HOLDER: Final = "holder.json"


def holder_of(root: Path, url: str) -> tuple[str, bool]:
    """Return the identity of a folder, and True if the folder was used with this bucket before. A
    copied or moved folder gets a new identity.

    Raises:
        OSError: the folder cannot be read or written.
    """
    identity: dict[str, Any] = {}
    with suppress(FileNotFoundError, ValueError):
        identity = json.loads((root / HOLDER).read_bytes())
    if _place_of(root, url).items() <= identity.items() and "holder" in identity:
        return str(identity["holder"]), True
    holder = secrets.token_hex(8)
    save_holder(root, url, holder)
    return holder, identity.get("copy") == url


def save_holder(root: Path, url: str, holder: str) -> None:
    """Store the identity of a folder that is used with the bucket `url`.

    Raises:
        OSError: the folder cannot be written.
    """
    with open_durably(root / HOLDER) as file:
        file.write(json.dumps({**_place_of(root, url), "holder": holder}).encode())


def _place_of(root: Path, url: str) -> dict[str, Any]:
    return {"copy": url, "host": socket.gethostname(), "folder": root.stat().st_ino}


def forget_holder(root: Path) -> None:
    """Remove the identity of a folder that is used without a lease (ownership in a bucket). Such a
    folder contains data that no bucket has, so it must not be synchronised with a bucket.

    Raises:
        OSError: the identity cannot be removed.
    """
    (root / HOLDER).unlink(missing_ok=True)
    (root / layout.EPOCH_FILE).unlink(missing_ok=True)
