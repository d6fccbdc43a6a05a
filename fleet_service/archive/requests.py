"""What the owner of an archive asks the service that runs on it, as files: erasure, which only the service may do.

    requests/NAME.json           the question: a month, and a vehicle or none
    requests/NAME.answer.json    what was done, or why not; the question is gone then

Whoever may write into the archive may ask. A question outlives the service: the next one finds it.
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
from schemas.runtime.durable import written

FOLDER: Final = "requests"
_ANSWER: Final = ".answer.json"
_SECRET: Final = 0o600  # a vehicle's name stands there until the question is answered
_KEPT_S: Final = 86_400.0  # an answer that nobody takes


@dataclass(frozen=True)
class Erasure:
    """Forget a month's key, or one vehicle's rows of that month."""

    month: str
    vehicle: str | None = None


def ask(root: Path, wanted: Erasure) -> Path:
    """Put a question; returns its file.

    Raises:
        OSError: it cannot be written.
    """
    folder = root / FOLDER
    folder.mkdir(mode=0o700, exist_ok=True)
    path = folder / f"{time.time_ns()}-{secrets.token_hex(4)}.json"
    with written(path, _SECRET) as file:
        file.write(json.dumps(asdict(wanted)).encode())
    owner = root.stat()
    for place in (folder, path):
        with suppress(PermissionError):  # an administrator asks for the user that the service runs as
            os.chown(place, owner.st_uid, owner.st_gid)
    return path


def answer_to(question: Path) -> dict[str, Any] | None:
    """What was answered, once; None: nothing yet.

    Raises:
        InputError: it was refused.
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


def waiting(root: Path) -> list[Path]:
    """Questions without an answer, the oldest first; answers that nobody took for a day go."""
    for path in (root / FOLDER).glob(f"*{_ANSWER}"):
        if time.time() - path.stat().st_mtime > _KEPT_S:
            path.unlink()
    return sorted(path for path in (root / FOLDER).glob("*.json") if not path.name.endswith(_ANSWER))


def read(question: Path) -> Erasure:
    """What is asked.

    Raises:
        InputError: it is none.
    """
    try:
        record = json.loads(question.read_bytes())
        return Erasure(str(record["month"]), None if record.get("vehicle") is None else str(record["vehicle"]))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError("request", f"{question.name} is none", "ask again") from error


def settle(question: Path, outcome: dict[str, Any] | InputError) -> None:
    """Answer a question and take it away.

    Raises:
        OSError: the answer cannot be written; the question stays.
    """
    if isinstance(outcome, InputError):
        outcome = {"error": [outcome.field, outcome.problem, outcome.fix]}
    with written(_answer_of(question), _SECRET) as file:
        file.write(json.dumps(outcome).encode())
    question.unlink()


def _answer_of(question: Path) -> Path:
    return question.with_name(question.stem + _ANSWER)
