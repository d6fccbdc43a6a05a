"""Campaign of simulated histories of the lease (a service's exclusive ownership of an archive) with
different lease times, skewed clocks, pauses, partitions and kills; see `lease_histories`.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple
from unittest.mock import patch

from fleet_service.replication import lease as lease_module
from fleet_service.replication.lease import Lease
from schemas.runtime.figures import Figure
from tests.faults.bars import make_figure
from tests.faults.frame import Site
from tests.faults.lease_histories import ServiceHistory, judge_history


class Judged(NamedTuple):
    """Sums over all simulated histories of a lease (exclusive ownership of an archive): violations
    (broken promises), failovers, acknowledgements, and refused starts.
    """

    acknowledged_by_two: int
    violations: int
    failovers: int
    acknowledged: int
    refused: int


def judge_seeds(seeds: Iterable[int]) -> Judged:
    """Simulate services that compete for a lease (exclusive ownership of an archive), once per
    seed; check each run, and return the sums of the results.
    """
    counts = [0] * len(Judged._fields)
    for seed in seeds:
        history = ServiceHistory(seed)
        history.run()
        verdict = judge_history(history.events)
        kinds = [event.kind for event in history.events]
        found = (
            verdict.acknowledged_by_two,
            verdict.violations,
            max(kinds.count("serves") - 1, 0),
            kinds.count("acknowledges"),
            history.refused,
        )
        counts = [one + other for one, other in zip(counts, found, strict=True)]
    return Judged(*counts)


def judge_without_comparison(seeds: Iterable[int]) -> Judged:
    """Check simulated histories of a broken lease protocol (lease: exclusive ownership of an
    archive), in which a service does not compare its lease time with that of the others.
    """
    with patch.object(lease_module, "_check_settings", lambda *_: None):
        return judge_seeds(seeds)


def judge_without_expiry(seeds: Iterable[int]) -> Judged:
    """Check simulated histories of a broken lease protocol (lease: exclusive ownership of an
    archive), in which a holder acknowledges until it notices its successor, even after its lease
    has expired.
    """
    fresh = property(lambda lease: not lease.lost)
    with patch.object(Lease, "may_acknowledge", fresh):
        return judge_seeds(seeds)


def run(site: Site) -> list[Figure]:
    """Check simulated histories of the real lease protocol (exclusive ownership of an archive), and
    of two broken protocols in which violations must be found; return the figures.
    """
    first = 1000 * site.seed
    judged = judge_seeds(range(first, first + site.choose_amount(200, 12)))
    controls = range(first, first + site.choose_amount(40, 12))
    unlike = judge_without_comparison(controls)
    endless = judge_without_expiry(controls)
    site.say(f"{judged}; without comparison {unlike}; without expiry {endless}")
    return [
        make_figure("faults.lease.acknowledged_by_two", judged.acknowledged_by_two),
        make_figure("faults.history.violations", judged.violations),
        make_figure("faults.history.failovers", judged.failovers),
        make_figure("faults.history.acknowledged", judged.acknowledged),
        make_figure("faults.lease.refused", judged.refused),
        make_figure("faults.lease.control_unlike", unlike.acknowledged_by_two),
        make_figure("faults.lease.control_endless", endless.acknowledged_by_two),
    ]
