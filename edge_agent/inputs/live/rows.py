"""Construction of rows (samples) at a fixed rate from the messages of live sources, a tenth of a
second at a time. The profile (assignment of signals to channels) and the merging are the same as in
the importer of recordings.

A row is built DELAY_S after its time, so that readings before and after it have arrived. If an
active source is late, for example on a busy computer, the row waits for up to PATIENCE_S longer.
Readings that arrive later are treated as missing, and counted. Rows follow the clock of this
computer: while all sources are silent the rows are empty, and the estimator's uncertainty grows. A
position that arrives after its row was sent is moved along its own course to the first row that has
not been sent.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Generator, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from edge_agent.inputs.block import Block
from edge_agent.inputs.channel_readings import make_channel, select_signals
from edge_agent.inputs.context import context_signals, held_readings
from edge_agent.inputs.live.feed import TICK_S, Feed, HostClock
from edge_agent.inputs.log_columns import (
    GROUND,
    fill_steering,
    remove_null_positions,
    split_front_angle,
)
from edge_agent.inputs.merge import COURSE_SPEED, SPARSE, sample_at_rows
from edge_agent.inputs.profile import Profile
from edge_agent.inputs.recording import Recording, Series
from schemas.errors import InputError
from schemas.numeric import FloatArray
from schemas.signals import CHANNELS, CONTEXT
from schemas.thresholds import EARTH_RADIUS_M, NS
from schemas.vehicle import Vehicle

RATE_HZ: Final = 100.0
BLOCK_S: Final = 0.1
DELAY_S: Final = 0.3  # [s] a channel of 10 Hz has delivered its next reading by then
PATIENCE_S: Final = 1.0  # [s] longest additional wait for an active source that is delayed
# [s] time for which readings before a row are kept; time stamps that arrive in bursts are smoothed
# over a second.
KEPT_S: Final = 3.0
# [s] If the host slept longer, the rows of this time are left out, and the estimator receives a
# gap.
MOST_BEHIND_S: Final = 5.0
OLDEST_FIX_S: Final = 2.0  # [s] older positions are not moved into a row


class LiveRows:
    """Generator of blocks (arrays of consecutive samples) of one vehicle from its live sources.

    Args:
        feeds: the live sources; the method `blocks` starts them.
        profile: assignment of signals to channels.
        vehicle: its wheel radius and steering ratio take precedence over those of the profile.
        clock: clock of the host; the feeds must have the same one.
        wait: function that sleeps for a number of seconds.

    Raises:
        InputError: the profile uses the steering wheel angle, and no steering ratio is given.
    """

    def __init__(
        self,
        feeds: Sequence[Feed],
        profile: Profile,
        vehicle: Vehicle,
        clock: HostClock,
        wait: Callable[[float], None] = time.sleep,
    ) -> None:
        self.feeds = feeds
        self._profile = profile
        self._clock = clock
        self._wait = wait
        self._vehicle = vehicle
        self._ratio = vehicle.steering_ratio or profile.steering_ratio
        if self._ratio is None and any(
            channel.at == "steering wheel" for channel in profile.channels.values()
        ):
            raise InputError(
                "steering_ratio", "is not known", "give it in the profile or the vehicle file"
            )
        self.rate_hz = profile.rate_hz or RATE_HZ
        self._readings: list[dict[str, Series]] = [{} for _ in feeds]
        # context signals; their last readings stay valid and are kept
        self._context = context_signals(profile)
        # time of the last fix that was written into a row
        self._used = dict.fromkeys(SPARSE, -math.inf)
        self._next = 0  # number of the next row
        self._date_ns: int | None = None
        # Number of rows left out, and of readings that arrived after their row was sent.
        self.skipped = 0
        self.late = 0
        # Speed over ground of the rows of the last block (T,) [m/s].
        self.ground: FloatArray = np.zeros(0)

    def blocks(self) -> Generator[Block]:
        """Yield blocks of samples in real time until the caller stops, then close the sources."""
        size = max(1, round(BLOCK_S * self.rate_hz))
        self._next = math.ceil(self._clock.now() * self.rate_hz)
        for feed in self.feeds:
            feed.start()
        try:
            while True:
                due = (self._next + size) / self.rate_hz + DELAY_S
                self._wait(max(0.0, due - self._clock.now()))
                while self._may_deliver(due - DELAY_S) and self._clock.now() < due + PATIENCE_S:
                    self._wait(TICK_S / 10.0)
                late_rows = int((self._clock.now() - due) * self.rate_hz)
                if late_rows > MOST_BEHIND_S * self.rate_hz:
                    self._next += late_rows
                    self.skipped += late_rows
                yield self._make_block(size)
        finally:
            for feed in self.feeds:
                feed.stopping.set()
            for feed in self.feeds:
                feed.close()

    def health_problems(self) -> list[str]:
        """Return one message for each live source that delivers nothing."""
        return [message for feed in self.feeds if (message := feed.silence_message)]

    def _may_deliver(self, time: float) -> bool:
        """Return True if a source may still deliver readings for rows before `time` [s].

        Sources that are silent do not count, and neither do position receivers, because their fixes
        are rare.
        """
        return any(
            feed.received_count
            and feed.newest < time
            and feed.silence_message is None
            and "course" not in kept
            for feed, kept in zip(self.feeds, self._readings, strict=True)
        )

    def _make_block(self, size: int) -> Block:
        t = np.arange(self._next, self._next + size) / self.rate_hz
        self._next += size
        recordings = [
            self._recent_recording(place, feed, t[0] - KEPT_S)
            for place, feed in enumerate(self.feeds)
        ]
        signals = np.full((size, len(CHANNELS)), np.nan)
        context = np.full((size, len(CONTEXT)), np.nan)
        self.ground = np.full(size, np.nan)
        fixes: dict[str, Series] = {}
        for name, (place, channel) in select_signals(recordings, self._profile).items():
            # Position fixes have exact times. Other readings have times of arrival, which
            # `make_channel` smooths.
            sparse = name in SPARSE
            try:
                series, _ = make_channel(
                    name,
                    channel,
                    replace(recordings[place], rows=sparse),
                    self._vehicle.wheel_radius,
                    self._ratio,
                )
            except InputError:  # the signal that gives the sign has not arrived yet
                continue
            series = Series(series.t - channel.delay_s, series.values)
            if name in CONTEXT:
                lasting = channel.lasting and self.feeds[place].silence_message is None
                context[:, CONTEXT.index(name)] = held_readings(name, series, t, lasting=lasting)
            elif sparse:
                fixes[name] = series
            else:
                signals[:, CHANNELS.index(name)] = sample_at_rows(series, t, sparse=False)
        self._place_fixes(fixes, t, signals)
        remove_null_positions(signals)
        self._fill_steering(signals)
        time = self._start_ns() + np.rint(t * NS).astype(np.int64)
        return Block(
            t[:, None], time[:, None], signals[:, None], context[:, None] if self._context else None
        )

    def _recent_recording(self, place: int, feed: Feed, oldest: float) -> Recording:
        """Return the readings of the live source `feed` since the time `oldest` [s], including
        those that were already used for rows. `place` is the index of the source.
        """
        kept = self._readings[place]
        arrived = feed.take()
        if "course" not in arrived:
            passed = oldest + KEPT_S - 1.0 / self.rate_hz
            late = [int((series.t < passed).sum()) for series in arrived.values()]
            self.late += max(late, default=0)
        for name, series in arrived.items():
            kept[name] = _join_series(kept.get(name), series)
        for name, series in list(kept.items()):
            first = int(np.searchsorted(series.t, oldest))
            if name in self._context:  # its last reading before `oldest` may still be valid
                first = max(min(first, int(np.searchsorted(series.t, oldest, side="right")) - 1), 0)
            if first == len(series.t):
                del kept[name]
            elif first:
                kept[name] = Series(series.t[first:], series.values[first:], series.unit)
        return Recording(feed.name, dict(kept))

    def _place_fixes(self, fixes: dict[str, Series], t: FloatArray, signals: FloatArray) -> None:
        """Write each position fix into the row (sample) of `signals` nearest to its time; `t` are
        the times of the rows [s]. If that row has already been sent to the estimator, move the fix
        along its course to the first row of the block.
        """
        half = 0.5 / self.rate_hz
        speed = fixes.get(GROUND)
        course = fixes.get("yaw")
        for name, series in fixes.items():
            is_fresh = (series.t > self._used[name]) & (series.t > t[0] - OLDEST_FIX_S)
            is_usable = (series.t < t[-1] + half) & np.isfinite(series.values)
            times = series.t[is_fresh & is_usable]
            values = series.values[is_fresh & is_usable]
            if not len(times):
                continue
            self._used[name] = float(times[-1])
            v = _readings_at(speed, times)
            if name == "yaw":
                values = np.where(np.isnan(v) | (v > COURSE_SPEED), values, np.nan)
            elif name in ("latitude", "longitude") and speed is not None and course is not None:
                distance = v * np.maximum(t[0] - half - times, 0.0)
                yaw = _readings_at(course, times)
                latitude = float(np.mean(_readings_at(fixes.get("latitude"), times)))
                values = values + _angle_moved(name, distance, yaw, latitude)
            rows = np.clip(np.searchsorted(t, times - half), 0, len(t) - 1)
            if name == GROUND:
                self.ground[rows] = values
            else:
                signals[rows, CHANNELS.index(name)] = values

    def _fill_steering(self, signals: FloatArray) -> None:
        """Fill missing steering angles in the same way as the reader of recorded logs. If the
        profile has only one front angle, the angles of the two front wheels are computed from it.
        Rear wheels get zero.
        """
        if fill_steering(signals, self._profile.channels):
            split_front_angle(signals, self._vehicle)

    def _start_ns(self) -> int:
        """Return the date [ns UTC] at which the host's clock started. The first position fix
        corrects this date permanently by the clock of the position receiver.
        """
        if self._date_ns is None and self._used["latitude"] > -math.inf:
            leads = [
                feed.stamps.added_s
                for feed, kept in zip(self.feeds, self._readings, strict=True)
                if "course" in kept
            ]
            self._date_ns = (
                self._clock.start_ns - round(leads[0] * NS) if leads else self._clock.start_ns
            )
        return self._clock.start_ns if self._date_ns is None else self._date_ns


def _readings_at(series: Series | None, times: FloatArray) -> FloatArray:
    """Return the readings of a signal at exactly the given times (n,), without interpolation; NaN
    at times without a reading.
    """
    found = np.full(len(times), np.nan)
    if series is not None and len(series.t):
        place = np.clip(np.searchsorted(series.t, times), 0, len(series.t) - 1)
        same = series.t[place] == times
        found[same] = series.values[place[same]]
    return found


def _join_series(before: Series | None, fresh: Series) -> Series:
    """Return the readings of two series of one signal in order of time."""
    t = fresh.t
    values = fresh.values
    if before is not None:
        t = np.concatenate([before.t, t])
        values = np.concatenate([before.values, values])
    order = np.argsort(t, kind="stable")
    return Series(t[order], values[order], fresh.unit)


def _angle_moved(name: str, distance: FloatArray, yaw: FloatArray, latitude: float) -> FloatArray:
    """Return the change [deg] of latitude or longitude, as `name` says, after a `distance` (n,) [m]
    in the direction `yaw` (n,) [rad]; 0 where one of them is NaN. `latitude` is in degrees.
    """
    along = np.nan_to_num(distance * (np.sin(yaw) if name == "latitude" else np.cos(yaw)))
    if name == "longitude":
        along /= math.cos(math.radians(latitude))
    return np.degrees(along / EARTH_RADIUS_M)
