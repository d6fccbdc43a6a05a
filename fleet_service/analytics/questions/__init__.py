"""Table of the predefined questions: for each its name, help text, sort order, and the column that
gives the colours of a map.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from importlib import import_module
from typing import TYPE_CHECKING, Final, NamedTuple

from schemas.errors import InputError
from schemas.runtime import plugins

if TYPE_CHECKING:
    import pyarrow as pa

    from fleet_service.analytics.engines import QueryEngine
    from fleet_service.analytics.options import Options


class Question(NamedTuple):
    """Question that can be asked about an archive.

    Attributes:
        name: name of the question on the command line.
        about: one line of help text.
        order: column by which the rows are sorted on the terminal; a leading minus means
            descending.
        colour: column that gives the colour of cells on a map; None if the answer has no place.
        answer: function that answers a question of a plug-in; None for a question of this package.
    """

    name: str
    about: str
    order: str
    colour: str | None
    answer: Callable[[QueryEngine, Options], pa.Table] | None = None

    @property
    def ask(self) -> Callable[[QueryEngine, Options], pa.Table]:
        """Return the function that answers the question. It is imported on demand, because Ibis
        takes long to import.
        """
        if self.answer is not None:
            return self.answer
        module = import_module(f"fleet_service.analytics.questions.{self.name.replace('-', '_')}")
        found: Callable[[QueryEngine, Options], pa.Table] = module.ask
        return found


QUESTIONS: Final = {
    question.name: question
    for question in (
        Question(
            "grip",
            "percentiles of mu per cell and day, and the share of unknown cells",
            "mu_p10",
            "mu_p50",
        ),
        Question("worst", "the most slippery stretches, merged into segments", "-score", "mu"),
        Question(
            "spells",
            "onset and duration of slippery spells, and the time to an alert",
            "onset",
            "duration_s",
        ),
        Question("before-after", "change of grip by a treatment, with interval", "-period", None),
        Question("trend", "grip month by month, compared in the same cells", "month", None),
        Question("vehicles", "bias and sensor health per vehicle", "-z", None),
        Question("calibration", "how often the published interval held", "age_h", None),
        Question(
            "weather",
            "grip as a function of the nearest station's temperature",
            "temperature",
            None,
        ),
        Question(
            "change-rates",
            "rates at which roads become slippery or recover, by temperature and hour",
            "by",
            None,
        ),
        Question(
            "contract",
            "time below the agreed grip on each link of a road network",
            "-least_s",
            None,
        ),
        Question("replay", "the map as of a moment, or frames over a period", "-p_slippery", "mu"),
    )
}


log = logging.getLogger(__name__)


def known_questions() -> dict[str, Question]:
    """Return all questions by name, including those that plug-ins (installed extensions) add. A
    plug-in that cannot be loaded is left out and logged.
    """
    others = {}
    for name in plugins.entry_points_of(plugins.QUESTIONS):
        try:
            others[name] = plugins.load_entry_point(plugins.QUESTIONS, name)
        except InputError as error:
            log.warning("%s", error)
    return others | QUESTIONS


def question_of(name: str) -> Question:
    """Return the question with this name.

    Raises:
        InputError: there is no question of that name, or its plug-in cannot be loaded.
    """
    if name in QUESTIONS:
        return QUESTIONS[name]
    if name in plugins.entry_points_of(plugins.QUESTIONS):
        found: Question = plugins.load_entry_point(plugins.QUESTIONS, name)
        return found
    raise InputError(
        "question", f"{name!r} is unknown", f"use one of {', '.join(known_questions())}"
    )
