"""Clock of the service. Neither a jump of the system clock nor a wrong system clock at the start
makes the service lose or refuse data.

A wall clock may jump: a time server corrects it, a machine wakes up, or a person sets it. The
service therefore runs on a monotonic clock from its start. It follows a jump of more than JUMP_NS
only if the reports of most current vehicles agree with the wall clock. Until then, the service
refuses no report that agrees with the wall clock or with the service's time. Such a report may have
a later time than the service. Then the service ignores it and sends no acknowledgement, so the
sender keeps the report and sends it again.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Final, NamedTuple

from schemas.thresholds import NS

# [ns] Largest jump of the wall clock that the service follows at once. A time server corrects
# errors of this size in one step, and they are harmless for reports.
JUMP_NS: Final = 60 * NS
# [ns] A report confirms the wall clock if it is younger than this and not part of a backlog.
NEAR_NS: Final = 600 * NS
VOTE_NS: Final = 5 * NS  # [ns] time in which every driving vehicle sends a report
OFF_NS: Final = 86_400 * NS  # [ns] after a longer downtime, the wall clock may be wrong
ANY: Final = 1 << 61  # [ns] possible error of a clock about which nothing is known


class TimeNow(NamedTuple):
    """Time of the service and how certain it is; all values in ns.

    Attributes:
        now: time of the service.
        slack: accepted reports may be this much later than `now`; above 0 if the archive contained
            later reports at the start.
        doubt: reports whose time is after `now` + `slack`, by at most this much, are neither
            accepted nor refused; their senders repeat them.
        earliest: lower bound of the true time.
        sure: False while the clock may be wrong; alerts whose time is over are then not ended.
    """

    now: int
    slack: int = 0
    doubt: int = 0
    earliest: int | None = None
    sure: bool = True


class SteadyClock:
    """Clock of the service [ns UTC], which follows no jumps of the wall clock.

    Args:
        seen: latest time of the reports in the archive when the service started; 0 without reports.
        wall, steady: functions that return the system's clocks [ns]; `steady` never jumps, and its
            zero is arbitrary.
    """

    def __init__(
        self,
        seen: int = 0,
        wall: Callable[[], int] = time.time_ns,
        steady: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._wall = wall
        self._steady = steady
        self._zero = wall() - steady()
        self._seen = seen
        self._began = steady()
        self._confirmed = False
        self._sure = 0 <= wall() - seen <= OFF_NS
        # steady time [ns] since which the wall clock differs; None if it agrees
        self._doubted: int | None = None
        # for each vehicle, True if its reports agree with the wall clock
        self._votes: dict[str, bool] = {}

    def now(self) -> int:
        """Return the service's time [ns UTC]. This time follows small forward steps of the wall
        clock at once, and larger steps only when reports confirm them.
        """
        even = self._zero + self._steady()
        wall = self._wall()
        if abs(wall - even) <= JUMP_NS:
            self._doubted = None
            self._votes.clear()
            self._zero += max(wall - even, 0)
            return max(wall, even)
        if self._doubted is None:
            self._doubted = self._steady()
        return even

    def moment(self) -> TimeNow:
        """Return the service's time, with its bounds and its certainty, as a `TimeNow`."""
        now = self.now()
        wall = self._wall()
        seen = self._seen + self._steady() - self._began
        slack = max(0, seen - now) if self._seen else 0
        if self._confirmed:
            return TimeNow(now, slack, max(0, wall - now - slack), min(now, wall))
        return TimeNow(now, slack, ANY, min(now, wall, seen) if self._seen else 0, self._sure)

    def record_reports(self, times: Mapping[str, int]) -> None:
        """Record the newest time [ns] that each vehicle just reported (`times`, by vehicle). The
        clock compares these times with the wall clock.
        """
        now = self.now()
        wall = self._wall()
        if self._doubted is None:
            self._confirmed = self._confirmed or any(
                abs(reported - now) <= NEAR_NS for reported in times.values()
            )
            return
        for vehicle, reported in times.items():
            if abs(reported - wall) <= NEAR_NS:
                self._votes[vehicle] = True
            elif abs(reported - now) <= NEAR_NS:
                self._votes[vehicle] = False
        if self._steady() - self._doubted >= VOTE_NS and 2 * sum(self._votes.values()) > len(
            self._votes
        ):
            self._zero = wall - self._steady()
            self._confirmed = True

    def lag(self) -> int:
        """Return how far the wall clock is behind the service's time [ns], negative if it is ahead.
        This is the size of a wall-clock jump that the service does not follow.
        """
        now = self.now()
        return max(now, self._seen) - self._wall()
