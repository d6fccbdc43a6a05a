"""Logger for tests that collects the lines of events in a list."""

from __future__ import annotations

import logging


def logger_into(lines: list[str]) -> logging.Logger:
    """Return a logger that appends each message to `lines`."""
    logger = logging.Logger("events")
    logger.addHandler(_ListHandler(lines))
    return logger


class _ListHandler(logging.Handler):
    def __init__(self, lines: list[str]) -> None:
        super().__init__()
        self._lines = lines

    def emit(self, record: logging.LogRecord) -> None:
        """Append the message of a record to the list."""
        self._lines.append(record.getMessage())
