"""Object storage by obstore: S3 and what speaks like it, GCS, Azure. Nothing hangs, and no error shows a credential.

An object is there whole or not at all, and durable when its put has returned; a put that timed out may have landed.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from schemas.errors import InputError

if TYPE_CHECKING:
    from obstore.store import ObjectStore

SCHEMES: Final = re.compile(r"(s3|gs|az|abfss?)://[^/]+")  # a folder or memory would not be a second place
CONNECT_S: Final = 2.0
_ENDPOINTS: Final = ("AWS_ENDPOINT_URL", "AWS_ENDPOINT")
_TOOK: Final = re.compile(r" in [\d.]+[^\s\d]*s\b")
_TEXT: Final = 160  # characters of an error; what the server says as XML may name keys


class CopyError(OSError):
    """The second place does not take or give an object; it is tried again."""


class ObjectBucket:
    """Objects below a URL.

    Args:
        url: as s3://bucket/folder.
        options: as obstore takes them beside the environment: endpoint, region, access_key_id …
        timeout_s: of one request, as a whole.

    Raises:
        InputError: obstore is not installed, or does not know the URL or an option.
    """

    def __init__(self, url: str, options: Mapping[str, str], timeout_s: float) -> None:
        if SCHEMES.match(url) is None:
            raise InputError("archive.copy", f"{url} is no bucket", "give a URL such as s3://bucket/folder")
        try:
            import obstore
            from obstore.exceptions import AlreadyExistsError, BaseError, NotFoundError
            from obstore.store import from_url
        except ImportError as error:
            fix = "pip install 'gripmap[objects]'"
            raise InputError("archive.copy", "a copy needs obstore, which is not installed", fix) from error
        self._do, self._known, self._missing = obstore, AlreadyExistsError, (NotFoundError, FileNotFoundError)
        self._failed: tuple[type[Exception], ...] = (BaseError, OSError)
        places = (options.get("endpoint"), options.get("aws_endpoint"), *map(os.environ.get, _ENDPOINTS))
        plain = next((place for place in places if place), "").startswith("http://")
        seconds = {"timeout": f"{timeout_s:g}s", "connect_timeout": f"{CONNECT_S:g}s"}
        client: Any = {**seconds, **({"allow_http": True} if plain else {})}  # else the environment decides
        retry: Any = {"max_retries": 2, "retry_timeout": timedelta(seconds=timeout_s)}
        given: Any = dict(options)
        try:
            self._store: ObjectStore = from_url(url, config=given, client_options=client, retry_config=retry)
        except (BaseError, ValueError, TypeError) as error:
            fix = "see `store` in the settings; credentials may come from the environment"
            raise InputError("archive.store", f"is not as {url} wants it ({reason(error)})", fix) from error

    def put(self, name: str, content: bytes | Path) -> None:
        """Put an object, in place of one that is there.

        Raises:
            CopyError: it is not known to have landed.
            FileNotFoundError: the file to be put is gone.
        """
        with self._telling(name):
            self._do.put(self._store, name, content)

    def put_new(self, name: str, content: bytes) -> None:
        """Put an object that must be new, or be these very bytes: then a put that timed out had landed.

        Raises:
            CopyError: as `put`, or it is another's.
        """
        with self._telling(name):
            try:
                self._do.put(self._store, name, content, mode="create")
            except self._known:
                if self.get(name) != content:
                    raise CopyError(f"{name}: another service has put an object of this name") from None

    def make(self, name: str, content: bytes) -> bool:
        """Put an object that must be new; whether it is this one that is there then.

        Raises:
            CopyError: as `put`.
        """
        with self._telling(name):
            try:
                self._do.put(self._store, name, content, mode="create")
            except self._known:
                return self.get(name) == content  # a put that timed out had landed
        return True

    def names(self, folder: str) -> list[str]:
        """Names of the objects in a folder, and below.

        Raises:
            CopyError: they cannot be listed.
        """
        with self._telling(f"the list of {folder}"):
            return [meta["path"] for page in self._do.list(self._store, prefix=folder) for meta in page]

    def get(self, name: str) -> bytes | None:
        """An object; None if there is none.

        Raises:
            CopyError: it cannot be read.
        """
        with self._telling(name):
            try:
                return bytes(self._do.get(self._store, name).bytes())
            except self._missing:
                return None

    def parts(self, name: str) -> Iterator[bytes]:
        """An object, a piece at a time.

        Raises:
            CopyError: as `get`, or there is none.
        """
        with self._telling(name):
            for part in self._do.get(self._store, name).stream():
                yield bytes(part)

    def sizes(self) -> dict[str, int]:
        """Names of all objects, and bytes.

        Raises:
            CopyError: they cannot be listed.
        """
        with self._telling("the list of objects"):
            return {meta["path"]: meta["size"] for page in self._do.list(self._store) for meta in page}

    def delete(self, name: str) -> None:
        """Delete an object, if there is one.

        Raises:
            CopyError: it may be there still.
        """
        with self._telling(name):
            try:
                self._do.delete(self._store, name)
            except self._missing:
                return

    @contextmanager
    def _telling(self, name: str) -> Iterator[None]:
        try:
            yield
        except CopyError:
            raise
        except FileNotFoundError as error:
            if error.filename is not None:
                raise  # the file to be put
            raise CopyError(f"{name}: {reason(error)}") from None
        except self._failed as error:
            raise CopyError(f"{name}: {reason(error)}") from None


def reason(error: BaseException) -> str:
    """The first words of an error: no headers, nothing of what the server answered, and not how long it took, so that
    the same trouble is the same line."""
    line = (str(error).splitlines() or [type(error).__name__])[0]
    return _TOOK.sub("", line.partition("<")[0]).strip()[:_TEXT]
