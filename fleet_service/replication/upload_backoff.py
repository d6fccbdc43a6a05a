"""Pauses after failed uploads to a bucket (object store), which grow with each further failure."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from fleet_service.replication.bucket import CopyError

BACK_OFF_S: Final = 0.5  # [s] pause after the first failure; each further failure doubles it
MOST_BACK_OFF_S: Final = 8.0


class UploadBackoff:
    """Record of failing uploads to the bucket at `url`. After a failure there is a pause, which
    grows with each further failure.

    Attributes:
        failures: number of failed uploads.
    """

    def __init__(self, url: str) -> None:
        self.failures = 0
        self._url = url
        self._in_a_row = 0
        self._not_before = 0.0
        self._error = ""
        self._since: float | None = None

    @property
    def away_s(self) -> float:
        """Return the time [s] for which the bucket has not accepted data on which an
        acknowledgement depends; 0 if it accepts them.
        """
        since = self._since
        return 0.0 if since is None else time.monotonic() - since

    @property
    def trouble(self) -> str | None:
        """Return a message to the operator about failing uploads to the bucket; None if there is no
        problem.
        """
        if self._since is None:
            return None
        waits = f"nothing is acknowledged for {self.away_s:.0f} s"
        return f"the copy at {self._url} does not accept segments, {waits}: {self._error}"

    @contextmanager
    def try_upload(self) -> Iterator[None]:
        """Run an upload to the bucket in this context, and record whether it succeeds.

        Raises:
            CopyError: the upload failed, or the pause after a failure has not ended.
        """
        if time.monotonic() < self._not_before:
            raise CopyError(f"the upload fails and is tried again: {self._error}")
        try:
            yield
        except CopyError as error:
            self.failures += 1
            self._error = str(error)
            self._since = self._since or time.monotonic()
            pause_s = min(BACK_OFF_S * 2.0**self._in_a_row, MOST_BACK_OFF_S)
            self._not_before = time.monotonic() + pause_s
            self._in_a_row = min(self._in_a_row + 1, 10)
            raise
        self._in_a_row = 0
        self._since = None
