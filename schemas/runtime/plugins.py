"""Plug-ins from other distributions: Python entry points, found by group and name. A plug-in never
replaces a built-in name.

    [project.entry-points."gripmap.estimators"]
    mine = "my_package.estimators:bank"

group                   object that the entry point must load
gripmap.estimators      function bank(vehicles) that returns an object with the method `advance` of
                        EstimatorBank; selected by `--estimator NAME`
gripmap.tyre_curves     function curve(theta) that returns tyre force / largest tyre force, for an
                        array `theta` of slips normalised as in `edge_agent.dynamics.tyres`;
                        selected with an estimator, for example by `--estimator aco-fckf@NAME`
gripmap.sources         function blocks(address) that returns an iterator of edge_agent.Block;
                        selected by `--source NAME:ADDRESS`
gripmap.questions       object of the class fleet_service.analytics.questions.Question
"""

from __future__ import annotations

from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Final

from schemas.errors import InputError

ESTIMATORS: Final = "gripmap.estimators"
TYRE_CURVES: Final = "gripmap.tyre_curves"
SOURCES: Final = "gripmap.sources"
QUESTIONS: Final = "gripmap.questions"


@cache
def entry_points_of(group: str) -> dict[str, EntryPoint]:
    """Return, by name, the entry points of a plug-in group that installed distributions declare."""
    return {point.name: point for point in entry_points(group=group)}


def load_entry_point(group: str, name: str) -> Any:  # noqa: ANN401 may be any object
    """Import and return the object that the entry point `name` of the plug-in group `group` refers
    to.

    Raises:
        InputError: the object cannot be imported.
    """
    try:
        return entry_points_of(group)[name].load()
    except (Exception, SystemExit) as error:  # the import of foreign code may raise anything
        field = group.rpartition(".")[2].removesuffix("s")
        where = entry_points_of(group)[name].value
        raise InputError(
            field,
            f"{name!r} cannot be loaded from {where} ({str(error) or type(error).__name__})",
            "correct or remove the plug-in",
        ) from error
