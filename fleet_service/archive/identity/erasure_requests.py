"""Erasure requests from the archive's owner to the running service, as files. Only the service
itself may erase data, because it also has data in memory.

    requests/NAME.json           the request: a month, and a vehicle or none
    requests/NAME.answer.json    the result, or the reason of refusal; replaces the request

Anyone with write access to the archive may make a request. A request survives a restart of the
service.
"""

from __future__ import annotations

import json
import os
import secrets
import time
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from schemas.errors import InputError
from schemas.runtime.durable import open_durably

FOLDER: Final = "requests"
_ANSWER: Final = ".answer.json"
_SECRET: Final = 0o600  # the file contains a vehicle's name until the request is answered
_KEPT_S: Final = 86_400.0  # [s] time for which an answer is kept if no process reads it


@dataclass(frozen=True)
class Erasure:
    """Request to erase data of one month.

    Attributes:
        month: the month, such as 2026-01.
        vehicle: name of the vehicle whose rows of the month are removed. If None, the secret key of
            the month's pseudonyms is destroyed; nobody can then attribute the rows to vehicles.
    """

    month: str
    vehicle: str | None = None


def write_request(root: Path, erasure: Erasure) -> Path:
    """Write a request to erase data; return the path of its file.

    Raises:
        OSError: the file cannot be written.
    """
    folder = root / FOLDER
    folder.mkdir(mode=0o700, exist_ok=True)
    path = folder / f"{time.time_ns()}-{secrets.token_hex(4)}.json"
    with open_durably(path, _SECRET) as file:
        file.write(json.dumps(asdict(erasure)).encode())
    # If root makes the request, the files must belong to the service's user.
    owner = root.stat()
    for place in (folder, path):
        with suppress(PermissionError):
            os.chown(place, owner.st_uid, owner.st_gid)
    return path


def answer_to(question: Path) -> dict[str, Any] | None:
    """Return the answer to a request to erase data, and remove the answer; None if the service has
    not answered yet.

    Raises:
        InputError: the request was refused.
    """
    path = _answer_of(question)
    try:
        answer: dict[str, Any] = json.loads(path.read_bytes())
    except FileNotFoundError:
        return None
    path.unlink()
    if "error" in answer:
        raise InputError(*answer["error"])
    return answer


def open_requests(root: Path) -> list[Path]:
    """Return the requests to erase data that have no answer yet, oldest first. Also remove answers
    that nobody has collected for a day.
    """
    for path in (root / FOLDER).glob(f"*{_ANSWER}"):
        if time.time() - path.stat().st_mtime > _KEPT_S:
            path.unlink()
    return sorted(
        path for path in (root / FOLDER).glob("*.json") if not path.name.endswith(_ANSWER)
    )


def read_request(question: Path) -> Erasure:
    """Return the content of a request to erase data.

    Raises:
        InputError: the request is not valid.
    """
    try:
        record = json.loads(question.read_bytes())
        return Erasure(
            str(record["month"]), None if record.get("vehicle") is None else str(record["vehicle"])
        )
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            "request", f"{question.name} is unknown", "send the request again"
        ) from error


def answer_request(question: Path, outcome: dict[str, Any] | InputError) -> None:
    """Answer a request to erase data, and remove the request.

    Raises:
        OSError: the answer cannot be written; the request stays.
    """
    if isinstance(outcome, InputError):
        outcome = {"error": [outcome.field, outcome.problem, outcome.fix]}
    with open_durably(_answer_of(question), _SECRET) as file:
        file.write(json.dumps(outcome).encode())
    question.unlink()


def _answer_of(question: Path) -> Path:
    return question.with_name(question.stem + _ANSWER)
