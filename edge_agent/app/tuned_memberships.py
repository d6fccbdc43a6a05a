"""Files of tuned memberships (parameters of the fuzzy sets): the memberships, their scores, and the
command that reproduces them.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from edge_agent.adaptation.memberships import RETIRED, Memberships
from schemas.config import explain_validation_error
from schemas.errors import InputError
from schemas.runtime.durable import write_durably

FOLDER: Final = Path(__file__).parent / "tuned"
# Untuned memberships, random search as the control, and the ant colony.
WAYS: Final = ("default", "random", "colony")

Finite = Annotated[float, Field(allow_inf_nan=False)]
Count = Annotated[int, Field(ge=1)]


class Record(BaseModel):
    """Base class of the records in a file of tuned memberships; unknown field names are
    rejected.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)


class Score(Record):
    """Scores of one set of memberships on one set of drives. Scores that need the true friction are
    null if the drives do not contain it.
    """

    interval_score: Annotated[
        Finite | None,
        Field(description="interval score of the 90 % friction interval, less is better [1]"),
    ]
    coverage: Annotated[
        Finite | None, Field(description="share of true frictions inside the interval [1]")
    ]
    log_likelihood: Annotated[
        Finite, Field(description="log-likelihood of the innovations, more is better [nat/s]")
    ]
    nis_ratio: Annotated[
        Finite, Field(description="normalised innovation squared over its expectation [1]")
    ]
    surface_score: Annotated[
        Finite | None, Field(description="interval score, mean over kinds of surface [1]")
    ] = None
    false_ice: Annotated[
        Finite | None, Field(description="share of grippy samples reported as slippery [1]")
    ] = None
    missed_ice: Annotated[
        Finite | None,
        Field(description="share of excited slippery samples not reported as slippery [1]"),
    ] = None


class SplitScores(Record):
    """Scores of memberships on the drives that the search used, and on held-out drives."""

    train: Score
    held_out: Score


class Budget(Record):
    """Limits of the searches for fuzzy sets: ants (candidates per iteration), iterations, and the
    number of parameter vectors that each search evaluated.
    """

    ants: Count
    iterations: Count
    evaluations: dict[str, Count]


class Provenance(Record):
    """Origin of the scores in a file of tuned memberships: all parameters needed to compute these
    scores again.
    """

    command: str
    seed: Annotated[int, Field(ge=0)]
    date: str
    commit: str
    machine: str
    versions: dict[str, str]
    budget: Budget


class Document(Record):
    """Content of a file of tuned memberships."""

    estimator: str
    memberships: dict[str, list[Finite]]
    objective: str
    winner: Annotated[
        str, Field(description="search that found the sets: the best on held-out drives")
    ] = "colony"
    scores: dict[str, SplitScores]
    candidates: Annotated[
        dict[str, list[dict[str, list[Finite]]]],
        Field(description="memberships found by every search, per kind of search"),
    ] = {}
    provenance: Provenance


@dataclass(frozen=True)
class Tuned:
    """Content of a file of tuned memberships after parsing: the validated memberships, and the
    complete document with scores and origin.
    """

    memberships: Memberships
    document: Document


def parse_tuned(text: str | bytes, where: str) -> Tuned:
    """Return the tuned memberships in a document. Errors name its origin `where`.

    Raises:
        InputError: a field is missing, unknown, not a finite number, or a vertex (corner of a fuzzy
            set) is out of order or out of range.
    """
    try:
        document = Document.model_validate_json(text)
    except ValidationError as error:
        raise explain_validation_error(error, where, Document) from error
    for way in WAYS:
        if way not in document.scores:
            raise InputError(
                f"scores.{way}", "is missing", f"write the {where} with edge-agent tune"
            )
    known = set(Memberships().to_json())
    if unknown := sorted(set(document.memberships) - known - set(RETIRED)):
        raise InputError(
            f"memberships.{unknown[0]}", "is unknown", f"use {', '.join(sorted(known))}"
        )
    return Tuned(Memberships.from_json(document.memberships), document)


def load_tuned(path: Path | str) -> Tuned:
    """Read a file of tuned memberships.

    Raises:
        InputError: a field is invalid, or the file cannot be read; the error names the field or the
            file.
    """
    try:
        text = Path(path).read_bytes()
    except OSError as error:
        raise InputError(
            "memberships",
            f"cannot read {path} ({error.strerror})",
            "name a file written by edge-agent tune",
        ) from error
    return parse_tuned(text, f"tuned file {path}")


def shipped_memberships(estimator: str) -> Memberships:
    """Return the tuned memberships that this package contains for an estimator.

    Raises:
        InputError: the package has no memberships for that estimator.
    """
    return load_tuned(FOLDER / f"{estimator}.json").memberships


def search_results(estimator: str) -> dict[str, list[Memberships]]:
    """Return the memberships that each search found, by kind of search. They are read from the file
    of memberships in this package. Return an empty dictionary if that file contains no results of
    searches.
    """
    document = load_tuned(FOLDER / f"{estimator}.json").document
    return {
        way: [Memberships.from_json(one) for one in found]
        for way, found in document.candidates.items()
    }


def save_tuned(path: Path, document: Document) -> None:
    """Write a document with tuned memberships to a file. It is parsed first, so that `load_tuned`
    accepts every file that is written.
    """
    text = json.dumps(document.model_dump(), indent=1, ensure_ascii=False) + "\n"
    parse_tuned(text, f"tuned file {path}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_durably(path, text)
    except OSError as error:
        raise InputError(
            "out", f"cannot write {path} ({error.strerror})", "name a file in a writable folder"
        ) from error
