"""Object storage through the library obstore: S3 and compatible, GCS, Azure. Every request has a
time limit, and no error message contains a credential.

An object is either complete or absent, and it is durable when its upload has returned. An upload
that timed out may still have succeeded.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import unquote, urlsplit

from schemas.errors import InputError
from schemas.runtime.installing import install_command

if TYPE_CHECKING:
    from obstore.store import ObjectStore

# A local folder is no second place, so `file://` is only for trials.
SCHEMES: Final = re.compile(r"(s3|gs|az|abfss?)://[^/]+|file:///.")
CONNECT_S: Final = 2.0
_ENDPOINTS: Final = ("AWS_ENDPOINT_URL", "AWS_ENDPOINT")
_TOOK: Final = re.compile(r" in [\d.]+[^\s\d.]*s\b")
_TEXT: Final = 160  # longest error text [characters]; the server's XML may contain key names


class CopyError(OSError):
    """Error of the bucket (object store): the bucket does not accept or return an object. The
    caller may repeat the request.
    """


def unusable_copy(url: str, error: CopyError) -> InputError:
    """Return the error with which a command ends because the bucket copy `url` does not answer."""
    return InputError(
        "archive.copy",
        f"{url} cannot be used ({error})",
        "check the network, endpoint, region and credentials, then start again; no data are lost",
    )


class ObjectBucket:
    """Bucket: access to the objects below a URL.

    Args:
        url: for example s3://bucket/folder; file:///folder is for trials on one machine.
        options: options of obstore, in addition to the environment: endpoint, region, access_key_id
            …
        timeout_s: total time limit of one request.
        retries: number of times that a failed request is repeated.

    Raises:
        InputError: obstore is not installed, or does not accept the URL or an option.
    """

    def __init__(
        self, url: str, options: Mapping[str, str], timeout_s: float, retries: int = 2
    ) -> None:
        if SCHEMES.match(url) is None:
            raise InputError(
                "archive.copy",
                f"{url} is not the URL of a bucket",
                "give a URL such as s3://bucket/folder, or file:///folder to try it",
            )
        try:
            import obstore
            from obstore.exceptions import AlreadyExistsError, BaseError, NotFoundError
            from obstore.store import LocalStore, from_url
        except ImportError as error:
            fix = install_command("objects")
            raise InputError(
                "archive.copy", "a copy needs obstore, which is not installed", fix
            ) from error
        self._do = obstore
        self._known = AlreadyExistsError
        self._missing = (NotFoundError, FileNotFoundError)
        self._failed: tuple[type[Exception], ...] = (BaseError, OSError)
        places = (
            options.get("endpoint"),
            options.get("aws_endpoint"),
            *map(os.environ.get, _ENDPOINTS),
        )
        plain = next((place for place in places if place), "").startswith("http://")
        seconds = {"timeout": f"{timeout_s:g}s", "connect_timeout": f"{CONNECT_S:g}s"}
        # Without "allow_http", the environment decides.
        client: Any = {**seconds, **({"allow_http": True} if plain else {})}
        retry: Any = {"max_retries": retries, "retry_timeout": timedelta(seconds=timeout_s)}
        given: Any = dict(options)
        try:
            self._store: ObjectStore = (
                LocalStore(unquote(urlsplit(url).path), mkdir=True)
                if url.startswith("file://")
                else from_url(url, config=given, client_options=client, retry_config=retry)
            )
        except (BaseError, ValueError, TypeError) as error:
            fix = "see `store` in the settings; credentials may come from the environment"
            raise InputError(
                "archive.store", f"does not fit {url} ({error_summary(error)})", fix
            ) from error

    def put(self, name: str, content: bytes | Path) -> None:
        """Upload an object to the bucket; an existing object of this name is replaced.

        Raises:
            CopyError: it is unknown whether the upload succeeded.
            FileNotFoundError: the file to upload no longer exists.
        """
        with self._as_copy_errors(name):
            self._do.put(self._store, name, content)

    def put_new(self, name: str, content: bytes) -> None:
        """Upload an object to the bucket; its name must be new. An existing object with the same
        content is accepted, because an earlier upload may have timed out although it succeeded.

        Raises:
            CopyError: it is unknown whether the upload succeeded, or the existing object has other
                content.
        """
        with self._as_copy_errors(name):
            try:
                self._do.put(self._store, name, content, mode="create")
            except self._known:
                if self.get(name) != content:
                    raise CopyError(
                        f"{name}: another service has written an object of this name"
                    ) from None

    def create(self, name: str, content: bytes) -> bool:
        """Create an object in the bucket if its name is new. Return True if it was created, or
        exists with the same content.

        Raises:
            CopyError: it is unknown whether the upload succeeded.
        """
        with self._as_copy_errors(name):
            try:
                self._do.put(self._store, name, content, mode="create")
            except self._known:
                return self.get(name) == content  # True after an upload that seemed to time out
        return True

    def list_names(self, folder: str) -> list[str]:
        """Return the names of the objects in a folder of the bucket and its subfolders.

        Raises:
            CopyError: the objects cannot be listed.
        """
        with self._as_copy_errors(f"the list of {folder}"):
            return [
                meta["path"] for page in self._do.list(self._store, prefix=folder) for meta in page
            ]

    def get(self, name: str) -> bytes | None:
        """Return the content of an object in the bucket; None if it does not exist.

        Raises:
            CopyError: the object cannot be read.
        """
        with self._as_copy_errors(name):
            try:
                return bytes(self._do.get(self._store, name).bytes())
            except self._missing:
                return None

    def read_parts(self, name: str) -> Iterator[bytes]:
        """Yield the content of an object in the bucket in pieces.

        Raises:
            CopyError: the object cannot be read or does not exist.
        """
        with self._as_copy_errors(name):
            for part in self._do.get(self._store, name).stream():
                yield bytes(part)

    def list_sizes(self) -> dict[str, int]:
        """Return names and sizes [bytes] of all objects in the bucket.

        Raises:
            CopyError: the objects cannot be listed.
        """
        with self._as_copy_errors("the list of objects"):
            return {
                meta["path"]: meta["size"] for page in self._do.list(self._store) for meta in page
            }

    def delete(self, name: str) -> None:
        """Delete an object in the bucket if it exists.

        Raises:
            CopyError: the object may still exist.
        """
        with self._as_copy_errors(name):
            try:
                self._do.delete(self._store, name)
            except self._missing:
                return

    @contextmanager
    def _as_copy_errors(self, name: str) -> Iterator[None]:
        try:
            yield
        except CopyError:
            raise
        except FileNotFoundError as error:
            if error.filename is not None:
                raise  # the local file to upload does not exist
            raise CopyError(f"{name}: {error_summary(error)}") from None
        except self._failed as error:
            raise CopyError(f"{name}: {error_summary(error)}") from None


def error_summary(error: BaseException) -> str:
    """Return the beginning of the message of a bucket's error, without headers, response body and
    duration, so that the same problem always gives the same line.
    """
    line = (str(error).splitlines() or [type(error).__name__])[0]
    return _TOOK.sub("", line.partition("<")[0]).strip()[:_TEXT]
