"""Log output of a long-lived process, as text for people or as JSON lines for programs.

Warnings and errors come from the loggers of the modules and libraries (`log_warnings`). Events of
operation, such as a status line, go to a logger of `event_logger`. Both use the same JSON form.
"""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Mapping
from contextlib import suppress
from datetime import UTC, datetime
from typing import Final, Literal, TextIO

Form = Literal["text", "json"]
_EVENTS: Final = "gripmap.events."


def event_logger(name: str, form: Form, stream: TextIO, **identity: object) -> logging.Logger:
    """Return the logger `name` of the process's events, which writes to `stream`. A second call
    with the same name changes the form and the stream.

    JSON lines contain the values `identity`, which identify the process, and those of
    `info(text, extra=values(name=value, …))`. Their field `event` is the value of that name, or the
    text before the first colon, or the first word of a text without colon.
    """
    logger = logging.getLogger(_EVENTS + name)
    logger.setLevel(logging.INFO)
    logger.propagate = False
    logger.handlers = [_make_handler(form, "%(message)s", stream, identity)]
    return logger


def log_warnings(form: Form, stream: TextIO, **identity: object) -> None:
    """Write the warnings and errors of the program and its libraries to `stream`. JSON lines
    contain the values `identity`, which identify the process.
    """
    handler = _make_handler(form, "%(levelname)s: %(message)s", stream, identity)
    logging.basicConfig(level=logging.WARNING, handlers=[handler], force=True)


def json_values(**entries: object) -> dict[str, object]:
    """Return the argument `extra` of a logger's method for a line with values by name, which the
    JSON form contains.
    """
    return {"values": entries}


class _TolerantHandler(logging.StreamHandler[TextIO]):
    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802 logging's name
        """Ignore errors of the stream, such as a full disk or a closed pipe."""


class _JsonFormatter(logging.Formatter):
    def __init__(self, identity: Mapping[str, object]) -> None:
        super().__init__()
        self._identity = identity

    def format(self, record: logging.LogRecord) -> str:
        message = record.getMessage()
        event = record.name
        if event.startswith(_EVENTS):
            event = message.partition(":" if ":" in message else " ")[0]
        fields = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "pid": os.getpid(),
            "event": event,
            "message": message,
            **self._identity,
            **getattr(record, "values", {}),
        }
        if record.exc_info:
            fields["error"] = self.formatException(record.exc_info)
        return json.dumps(fields, default=str)


def _make_handler(
    form: Form, text: str, stream: TextIO, identity: Mapping[str, object]
) -> logging.Handler:
    handler = _TolerantHandler(stream)
    handler.setFormatter(_JsonFormatter(identity) if form == "json" else logging.Formatter(text))
    return handler


def print_line(line: str, stream: TextIO) -> None:
    """Print a line with one write and flush it, so that lines of several threads do not mix. Errors
    of the stream (full disk, closed pipe) are ignored.
    """
    with suppress(OSError):
        stream.write(f"{line}\n")  # one write: `print` writes the line feed separately
        stream.flush()
