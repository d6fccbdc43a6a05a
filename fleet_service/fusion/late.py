"""Fusion of observations that arrive after the checkpoint (the time before which observations are
final). Each is fused at the checkpoint, with its likelihood aged from the time of the visit to the
checkpoint. Pure (no I/O).

The model of a changing road is a Markov chain: a diffusion with reflecting ends, and sudden changes
to any friction. The chain is reversible and leaves the uniform belief uniform. So the likelihood of
the road at the checkpoint C, given a measurement at an earlier time t, is

    L_C(μ) = Σ_ν P(μ_t = ν | μ_C = μ)·L(ν) = forgetting applied to L over C - t

If no other vehicle visited the cell between t and C, the result equals that of an observation in
time. Otherwise the late visit is fused after the others, as an old report about the present road.
All late visits get times directly after the checkpoint, the newest visit first. So of several
visits of one vehicle to a cell, the newest counts fully and the older ones as repetitions. The
order of arrival between two checkpoints does not matter.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from fleet_service.fusion import constants
from fleet_service.fusion.belief import PADDED, PRIOR, Bins, forget, largest_bin
from fleet_service.fusion.observations import Observations
from fleet_service.fusion.weather import Weather, road_time
from schemas import grid, mugrid
from schemas.numeric import ByteArray, IntArray
from schemas.runtime.jit import refcount_free_locked
from schemas.thresholds import NS, US_STEP

# [ns] A late visit is fused only if it is at most this much older than the checkpoint. After this
# time, the road has probably changed.
LATE_MOST_NS: Final = int(constants.CHANGE_S) * NS
# [ns] Interval directly after the checkpoint in which late visits get their times.
_PLACES_NS: Final = NS
_FLOOR: Final = mugrid.FLOOR_STEPS


def fused_at(time: IntArray, checkpoint: int) -> IntArray:
    """Return the time [ns] at which each late visit is fused, given the visits' end times `time`
    (n,) [ns]. All returned times lie within one second after `checkpoint` [ns], because older
    observations are final. The newest visit gets the earliest time, so that it is fused first and
    counts fully; older visits of the same vehicle then count as repetitions. The delays after the
    checkpoint are whole microseconds, the resolution of times in the archive.
    """
    age = np.clip(checkpoint - time, 0, LATE_MOST_NS)
    return np.asarray(checkpoint + age // (LATE_MOST_NS // _PLACES_NS) // US_STEP * US_STEP)


def delay_observations(
    observations: Observations, late_by: IntArray, weather: Weather
) -> Observations:
    """Return the observations with their times moved forward by `late_by` (n,) [ns]. Their
    likelihoods are aged by the same time, because the road may have changed since.
    """
    rows = np.flatnonzero(late_by)
    evidence = observations.evidence.copy()
    evidence[rows] = aged_evidence(
        observations.evidence[rows],
        observations.cell[rows] * grid.SECTORS,
        observations.time[rows],
        observations.time[rows] + late_by[rows],
        weather,
    )
    return replace(observations, time=observations.time + late_by, evidence=evidence)


def aged_evidence(
    evidence: ByteArray, key: IntArray, begin: IntArray, end: IntArray, weather: Weather
) -> ByteArray:
    """Return the likelihood of the road's friction at time `end` [ns], given an observation at the
    earlier time `begin` [ns], for each of n observations: log-likelihoods (n, 32) in steps of 1/16
    nat. `key` (n,) is the cell and sector of each observation.
    """
    out = np.empty_like(evidence)
    scratch = np.empty((2, PADDED), np.float32)
    _age_evidence(evidence, Times(key, begin, end), weather, scratch, out)
    return out


class Times(NamedTuple):
    """Cell and sector of each of n observations, time of the observation [ns], and time to which
    its likelihood is aged [ns], each (n,).
    """

    key: IntArray
    begin: IntArray
    end: IntArray


@refcount_free_locked
def _age_evidence(
    evidence: ByteArray, times: Times, weather: Weather, scratch: Bins, out: ByteArray
) -> None:
    likelihood = scratch[0, : mugrid.BINS]
    padded = scratch[1]
    for n in range(len(evidence)):
        whole = np.float32(0.0)
        for i in range(mugrid.BINS):
            likelihood[i] = np.exp(-np.float32(evidence[n, i]) / mugrid.STEPS_PER_NAT)
            whole += likelihood[i]
        for i in range(mugrid.BINS):
            likelihood[i] /= whole
        drift, change, _ = road_time(weather, times.key[n], times.begin[n], times.end[n])
        forget(likelihood, drift, change, PRIOR, padded)
        most = largest_bin(likelihood)
        for i in range(mugrid.BINS):
            steps = mugrid.STEPS_PER_NAT * np.log(most / max(likelihood[i], np.float32(1e-30)))
            out[n, i] = np.uint8(min(steps + 0.5, float(_FLOOR)))
