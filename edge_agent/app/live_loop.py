"""Live loop: in real time, passes blocks (consecutive samples) to the pipeline, which estimates
friction and makes records. The loop gives these records to the publisher until it is stopped.

The loop waits so that no block is processed before its time. A block counts as late if its
processing ends more than the block's own duration behind real time. No block is skipped: a loop
that is behind real time processes the next blocks without waiting.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

from edge_agent.inputs.block import Block
from edge_agent.observe.observation_builder import RecordBlock
from edge_agent.observe.pipeline import Pipeline
from edge_agent.publish.publisher import Publisher
from schemas.runtime import watchdog
from schemas.wire import Kind

STATUS_EVERY_S = 5.0
# [s] time to send remaining records after a signal. The agent then ends within 3 s, including one
# second for sessions that hang.
STOPPED_DRAIN_S = 1.7
ENDED_DRAIN_S = 10.0  # [s] time to send remaining records when the signals have ended

log = logging.getLogger(__name__)


@dataclass
class Progress:
    """Progress of the live loop (estimation in real time).

    Attributes:
        signals_s: duration of the processed signals [s].
        blocks: number of processed blocks of samples.
        late_blocks: number of blocks that were delayed by more than their own duration.
        lag_s, longest_lag_s: delay after the last block, and the longest delay [s].
        unverified_records: number of records that were not published, because their signals were
            not verified.
    """

    signals_s: float = 0.0
    blocks: int = 0
    late_blocks: int = 0
    lag_s: float = 0.0
    longest_lag_s: float = 0.0
    unverified_records: int = 0

    def record_block(self, length_s: float, elapsed_s: float) -> float:
        """Count a processed block whose signals last `length_s` seconds, `elapsed_s` seconds after
        the start of the clock. Return the delay of the loop [s], negative if it is ahead of the
        signals.
        """
        self.signals_s += length_s
        self.blocks += 1
        lag = elapsed_s - self.signals_s
        if lag > length_s:
            self.late_blocks += 1
        self.longest_lag_s = max(self.longest_lag_s, lag)
        self.lag_s = max(lag, 0.0)
        return lag


class LoopOptions(NamedTuple):
    """Options of the live loop.

    Attributes:
        on_status: function that receives the progress every STATUS_EVERY_S seconds.
        duration_s: time after which the loop ends [s].
        clock: returns the time of a monotonic clock [s].
        is_admitted: function that returns True if the records of a block may be published; records
            that may not be published are only counted.
        after_block: function that the loop calls after each block of samples.
    """

    on_status: Callable[[Progress], None] = lambda _: None
    duration_s: float = float("inf")
    clock: Callable[[], float] = time.monotonic
    is_admitted: Callable[[], bool] = lambda: True
    after_block: Callable[[], None] = lambda: None


def run_live_loop(
    blocks: Iterator[Block],
    pipeline: Pipeline,
    publisher: Publisher,
    stop: threading.Event,
    options: LoopOptions,
    progress: Progress | None = None,
) -> Progress:
    """Process blocks of samples until the source ends, the duration has passed or `stop` is set;
    then close the open visits (passages of a map cell).

    The counters in `progress` are updated during the run, and returned at the end.
    """
    progress = progress or Progress()
    status_at = STATUS_EVERY_S
    doubted: set[tuple[int, str]] = set()
    started = float("nan")
    first = float("nan")
    for block in blocks:
        _, observations, states = pipeline.step(block)
        _offer_if_admitted(publisher, progress, options.is_admitted(), observations, states)
        options.after_block()
        _warn_of_flags(pipeline, doubted)
        if not progress.blocks:
            # Start the clock after the first block, which may have loaded compiled kernels.
            started = options.clock()
            first = float(block.t.min())
        length = float(block.t.max()) - first - progress.signals_s
        lag = progress.record_block(length, options.clock() - started)
        if stop.wait(max(0.0, -lag)) or options.clock() - started >= options.duration_s:
            break
        if options.clock() - started >= status_at:
            status_at += STATUS_EVERY_S
            if not publisher.is_broken:
                watchdog.notify_alive()
            options.on_status(progress)
    if (last := pipeline.finish()) is not None:
        _offer_if_admitted(publisher, progress, options.is_admitted(), last)
    return progress


def _warn_of_flags(pipeline: Pipeline, warned: set[tuple[int, str]]) -> None:
    """Log each controller flag (ABS, ESC or traction control is active) that the pipeline ignores
    as implausible, once per vehicle. `warned` contains the flags logged so far.
    """
    for vehicle, flag, reason in pipeline.doubted_flags():
        if (vehicle, flag) not in warned:
            warned.add((vehicle, flag))
            log.warning(
                "vehicle %d: %s %s: it is treated as unknown; correct the profile",
                vehicle,
                flag,
                reason,
            )


def _offer_if_admitted(
    publisher: Publisher, progress: Progress, admitted: bool, *records: RecordBlock
) -> None:
    if admitted:
        publisher.offer(*records)
    else:
        progress.unverified_records += sum(len(block.vehicle) for block in records)


def final_counts(progress: Progress, publisher: Publisher) -> dict[str, float]:
    """Return the numbers that the agent prints at its end, by name. They are counts of records and
    of observations (one kind of record) by result, counts of blocks of samples, and the largest
    delay of the loop [s].
    """
    counts = publisher.counts
    kind = Kind.OBSERVATION
    return {
        "published": sum(counts.published.values()),
        "acknowledged": sum(counts.acknowledged.values()),
        "unsettled": publisher.count_unsettled(),
        "rejected": sum(counts.rejected.values()),
        "dropped": publisher.status.dropped_records,
        "held": progress.unverified_records,
        "behind": progress.late_blocks,
        "blocks": progress.blocks,
        "lag_s": round(progress.longest_lag_s, 3),
        "signals_s": round(progress.signals_s, 3),
        "resent_batches": counts.resent_batches,
        "observations_published": counts.published[kind],
        "observations_acknowledged": counts.acknowledged[kind],
        "observations_unsettled": publisher.count_unsettled(kind),
        "observations_rejected": counts.rejected[kind],
    }
