"""Static files of the page, read and compressed once. The JavaScript modules are bundled into one
script.
"""

from __future__ import annotations

import gzip
import hashlib
import mimetypes
from pathlib import Path
from typing import Final, NamedTuple

from starlette.requests import Request
from starlette.responses import Response

from fleet_service.page.module_bundle import bundle_modules

LEVEL: Final = 9
ENGLISH: Final = "texts.en.json"
SCRIPT: Final = "page.js"  # bundle of all modules, beginning with main.js


class _File(NamedTuple):
    plain: bytes
    packed: bytes
    kind: str
    tag: str


class Files:
    """Static files of a folder, which the page's web server delivers.

    Args:
        folder: folder, which is read once.
    """

    def __init__(self, folder: Path) -> None:
        plain = {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}
        modules = {
            name.removesuffix(".js"): text.decode()
            for name, text in plain.items()
            if name.endswith(".js")
        }
        plain[SCRIPT] = bundle_modules(modules, "main").encode()
        self._files = {name: _pack_file(name, text) for name, text in plain.items()}

    def texts(self, accepted: str) -> str:
        """Return the file name of the page's texts in the first language of the browser that is
        available, or else in English.

        Args:
            accepted: value of the header `Accept-Language`, the preferred language first.
        """
        languages = [language.partition(";")[0].strip().lower() for language in accepted.split(",")]
        names = [
            f"texts.{tag}.json"
            for language in languages
            for tag in (language, language.partition("-")[0])
        ]
        return next((name for name in names if name in self._files), ENGLISH)

    def answer(self, name: str, request: Request, vary: str = "Accept-Encoding") -> Response | None:
        """Return a response with a file, compressed if the browser accepts this, or "not modified".
        Return None if there is no such file.
        """
        file = self._files.get(name)
        if file is None:
            return None
        headers = {"Cache-Control": "no-cache", "ETag": file.tag, "Vary": vary}
        if request.headers.get("if-none-match") == file.tag:
            return Response(status_code=304, headers=headers)
        if "gzip" not in request.headers.get("accept-encoding", ""):
            return Response(file.plain, media_type=file.kind, headers=headers)
        return Response(
            file.packed, media_type=file.kind, headers={**headers, "Content-Encoding": "gzip"}
        )


def _pack_file(name: str, plain: bytes) -> _File:
    kind = mimetypes.guess_type(name)[0] or "application/octet-stream"
    tag = f'"{hashlib.sha256(plain).hexdigest()[:16]}"'
    return _File(plain, gzip.compress(plain, LEVEL, mtime=0), kind, tag)
