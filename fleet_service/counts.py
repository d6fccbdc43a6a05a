"""Counts of a running service, which its parts increase and its metrics show."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, fields

from schemas.wire import Kind


def _count(text: str) -> int:
    count: int = field(default=0, metadata={"text": text})
    return count


@dataclass
class ServiceCounts:
    """Counts since the start of a service. Several threads increase them.

    Attributes:
        files_set_aside: damaged files that were set aside, at the last count.
        rows: rows admitted, by kind.
        refused: batches (messages with records) that were refused, by reason.
        bad_queries: queries that were refused, by parameter.
        failures: failed operations, which the service tries again, by work.
        runs: completed runs of background jobs, by job.

    The text of each other count describes its metric.
    """

    late: int = _count("observations not fused in time, but as old ones or not at all")
    implausible_moves: int = _count(
        "observations archived but not fused because their vehicle cannot have reached the place"
    )
    too_many_places: int = _count(
        "observations archived but not fused because their vehicle reported too many new places"
    )
    weather: int = _count("weather reports admitted")
    duplicates: int = _count("duplicate batches")
    too_many_gaps: int = _count("batches refused because their stream has too many gaps")
    too_many_streams: int = _count(
        "batches not accepted because their vehicle opened too many streams; the vehicle keeps them"
    )
    key_failures: int = _count(
        "batches refused because the key of their month is damaged or cannot be written"
    )
    clock_doubted: int = _count(
        "batches neither admitted nor refused because the service's time is uncertain"
    )
    overload: int = _count("messages dropped because the queue was full")
    limited: int = _count("messages dropped because their vehicle exceeded its rate limit")
    queries: int = _count("queries")
    heavy_queries: int = _count("queries answered in a separate thread because of their cost")
    refused_queries: int = _count(
        "queries refused because too many were waiting; the client may retry"
    )
    tile_rounds_skipped: int = _count(
        "publications of tiles skipped because the previous one was not finished"
    )
    checkpoints_refused: int = _count(
        "checkpoints not used: damaged, of another version, or fatal to a former start"
    )
    witnesses_damaged: int = _count(
        "damaged lines in keys/MONTH.witnesses at the start of the service"
    )
    files_set_aside: int = 0
    rows: Counter[Kind] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    bad_queries: Counter[str] = field(default_factory=Counter)
    failures: Counter[str] = field(default_factory=Counter)
    runs: Counter[str] = field(default_factory=Counter)

    @property
    def observations(self) -> int:
        """Return the number of admitted observations."""
        return self.rows[Kind.OBSERVATION]

    @property
    def states(self) -> int:
        """Return the number of admitted vehicle states."""
        return self.rows[Kind.STATE]

    def texts(self) -> dict[str, str]:
        """Return the text of each single count by name."""
        return {one.name: one.metadata["text"] for one in fields(self) if "text" in one.metadata}

    def as_dict(self) -> dict[str, int]:
        """Return all counts by name, such as `late`, `refused.time` and `compaction_failures`."""
        # `dict` copies at once. Another thread may add a key during an iteration.
        return {
            **{name: getattr(self, name) for name in (*self.texts(), "files_set_aside")},
            **{str(kind): n for kind, n in dict(self.rows).items()},
            **{f"refused.{reason}": n for reason, n in dict(self.refused).items()},
            **{f"bad_queries.{name}": n for name, n in dict(self.bad_queries).items()},
            **{f"{work}_failures": n for work, n in dict(self.failures).items()},
            **{f"{job}_runs": n for job, n in dict(self.runs).items()},
        }
