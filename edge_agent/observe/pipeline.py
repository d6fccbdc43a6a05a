"""One step of the estimation loop. From a block of samples it computes the map cells in which the
vehicles are, the estimates of motion and friction, and the records for publication.

The step is the same for one car and for a fleet, live and in a replay.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from edge_agent.inputs.block import Block
from edge_agent.observe.cell_tracker import NOWHERE, locate_vehicles, new_tracks
from edge_agent.observe.controller_flags import doubted_flags, new_flag_records, trusted_context
from edge_agent.observe.observation_builder import (
    BlockReadings,
    OpenVisits,
    RecordBlock,
    build_records,
)
from edge_agent.observe.trip_privacy import TripEnds
from schemas.grid import SECTORS
from schemas.numeric import FloatArray, IntArray
from schemas.thresholds import NS

if TYPE_CHECKING:
    from edge_agent.estimators import Estimates, EstimatorBank
    from schemas.config import AgentConfig

# [s] time from the last sample to the final empty one; short, so that the estimate hardly changes
FINAL_STEP_S = 1e-3


class Seen(NamedTuple):
    """Position and motion of the vehicles at the end of a block of samples, (N,) each: latitude and
    longitude [deg], yaw [rad from east], speed [m/s], time [ns UTC]; NaN where unknown.
    """

    latitude: FloatArray
    longitude: FloatArray
    yaw: FloatArray
    speed: FloatArray
    time: IntArray


class Grip(NamedTuple):
    """Friction of the vehicles at the end of a block of samples, (N,) each: median, lower and upper
    quantile of the friction mu, grip used (force over load), time [ns UTC]. A value is NaN where
    unknown.
    """

    mu: FloatArray
    mu_lower: FloatArray
    mu_upper: FloatArray
    mu_utilised: FloatArray
    time: IntArray


class Pipeline:
    """Estimation and record building for N vehicles: their estimators (the bank) and their open
    visits (passages of a map cell). Call `step` for each block of samples in order, then `finish`
    once.
    """

    def __init__(self, bank: EstimatorBank, vehicles: int, config: AgentConfig) -> None:
        self._bank = bank
        self._config = config
        self._tracks = new_tracks(vehicles)
        self._open = OpenVisits.before_any(vehicles)
        self._ends = TripEnds(vehicles, config.trip_end_m, config.trip_end_s)
        self._last: Block | None = None
        self._flags = new_flag_records(vehicles)
        self.seen: Seen | None = None
        self.grip: Grip | None = None
        self.places: IntArray = np.full(vehicles, NOWHERE)  # cell * 4 + sector at the block's end

    def step(self, block: Block) -> tuple[Estimates, RecordBlock, RecordBlock]:
        """Process a block of at least one sample. Return the estimates of all samples, the
        observations of ended visits, and the vehicles' states (position, motion and friction at a
        fixed rate).

        For privacy, records near the beginning and end of a trip are left out.
        """
        self._tracks, located = locate_vehicles(self._tracks, block.t, block.signals)
        estimates = self._bank.advance(block.t, block.signals, located.closes)
        context = block.context
        if context is not None:
            self._flags, context = trusted_context(self._flags, block.t, block.signals, context)
        self._open, observations, states = build_records(
            self._open,
            block.time,
            located,
            estimates,
            self._config,
            BlockReadings(block.signals, context),
        )
        self._last = block
        self.seen = Seen(
            located.latitude[-1],
            located.longitude[-1],
            located.yaw[-1],
            estimates.vx[-1],
            block.time[-1],
        )
        self.grip = Grip(
            estimates.mu[-1],
            estimates.mu_lower[-1],
            estimates.mu_upper[-1],
            estimates.mu_utilised[-1],
            block.time[-1],
        )
        cell = located.cell[-1]
        sector = located.sector[-1]
        self.places = np.where(cell == NOWHERE, NOWHERE, cell * SECTORS + sector)
        self._ends.advance(block.t, block.time, estimates.vx)
        return (
            estimates,
            self._ends.release_records(observations),
            self._ends.release_records(states),
        )

    def beliefs(self) -> tuple[FloatArray, FloatArray] | None:
        """Return two arrays (N, 32) over the bins of the friction grid, or None if the estimator
        has no grid. The first is log(posterior/uniform) of each vehicle's friction. The second is
        the log-likelihood of the measurements in the current visit so far.
        """
        return self._bank.beliefs()

    def doubted_flags(self) -> list[tuple[int, str, str]]:
        """Return a list of the controller flags that are implausible and therefore ignored now, as
        (index of the vehicle, name of the flag, reason).
        """
        return doubted_flags(self._flags)

    def finish(self) -> RecordBlock | None:
        """Close the open visits and return their observations; None if no sample was processed.

        The evidence (log-likelihood of friction) of a visit becomes available only at the sample
        after its end. Therefore the method first adds one sample without readings and without a
        position.
        """
        if self._last is None:
            return None
        t = self._last.t[-1:] + FINAL_STEP_S
        time = self._last.time[-1:] + round(FINAL_STEP_S * NS)
        empty = np.full((1, *self._last.signals.shape[1:]), np.nan)
        tracks, located = locate_vehicles(self._tracks, t, empty, lost=True)
        estimates = self._bank.advance(t, empty, located.closes)
        self._tracks = tracks
        self._open, observations, _ = build_records(
            self._open, time, located, estimates, self._config
        )
        return self._ends.release_records(observations)
