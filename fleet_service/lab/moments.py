"""Evaluation of the map at several moments of a drive with the real estimator: after one, six and
thirty minutes.

A map that is calibrated after a minute may later become overconfident about errors that all
vehicles share. A map that is calibrated after half an hour may have been overconfident in the first
minute. Therefore the map is read at all MOMENTS, and the worst result counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from fleet_service.fusion import Fusion
from fleet_service.lab import end_to_end
from fleet_service.lab.drive import LATENESS_S
from fleet_service.lab.end_to_end import OBSERVATIONS, SEVERAL, TRUTH
from fleet_service.lab.score import (
    Scores,
    by_surface,
    false_grip,
    false_ice,
    join_scores,
    mean_or_nan,
    of_beliefs,
    slippery_scores,
)
from fleet_service.serve.view import LOWER, UPPER, is_measured
from schemas import mugrid
from schemas.numeric import BoolArray, FloatArray
from schemas.thresholds import NS

MOMENTS: Final = (60.0, 360.0, 1800.0)  # [s] after the first observation
# Middle of the target range of the coverage. The worst drive is the one farthest from it.
MIDDLE: Final = 0.91


class AskedWay(NamedTuple):
    """Scores of the map at one moment of a drive.

    Attributes:
        scores: scores of the cells that several vehicles had visited.
        measured: mask of these cells: True if a vehicle measured friction there, and not only a
            lower bound.
        one_surface: mask of these cells: True if all visits so far truly had the same friction. The
            true friction of the other cells, which contain a border, is a mean.
    """

    scores: Scores
    measured: BoolArray
    one_surface: BoolArray


def ask_moments(folder: Path) -> list[AskedWay]:
    """Return the scores of the map at each of MOMENTS that the drive in `folder` reaches."""
    observations = end_to_end.observations_in(end_to_end.read_observations(folder / OBSERVATIONS))
    visits = pq.read_table(folder / TRUTH)
    begin = int(observations.time.min())
    left = visits["leave_time"].cast(pa.int64())
    fusion = Fusion(LATENESS_S)
    taken = begin - 1
    out = []
    for seconds in MOMENTS:
        until = begin + int(seconds * NS)
        rows = np.flatnonzero((observations.time > taken) & (observations.time <= until))
        if not len(rows):
            break
        end_to_end.raised_alerts(fusion, observations.take(rows))
        past = visits.filter(pc.less_equal(left, pa.scalar(until)))
        taken = until
        slots, truth = end_to_end.slots_with_truth(fusion, past)
        several = fusion.live.vehicles[slots] >= SEVERAL
        slots = slots[several]
        truth = truth[several]
        belief = fusion.beliefs(slots, until)
        lower = mugrid.quantiles(belief, LOWER)
        upper = mugrid.quantiles(belief, UPPER)
        scores = of_beliefs(belief, truth, end_to_end.excited_vehicles(fusion, past)[slots])
        out.append(
            AskedWay(
                scores,
                is_measured(
                    lower, upper, fusion.live.values[slots], belief @ mugrid.SLIPPERY_SHARE
                ),
                end_to_end.one_surface(fusion, past)[slots],
            )
        )
    return out


def moment_figures(ways: Sequence[Sequence[AskedWay]], prefix: str) -> dict[str, float]:
    """Return the figures of several drives (at least 10 for a judgement): for each moment the mean,
    the worst value and the spread over the drives.

    Error and coverage are computed for measured cells only. The interval of an untested cell
    reaches to the end of the grid, so it always covers the true friction.
    """
    out: dict[str, float] = {f"{prefix}.ways": float(len(ways))}
    for k, seconds in enumerate(MOMENTS[: min(map(len, ways))]):
        name = f"after{seconds / 60.0:.0f}"
        now = [way[k] for way in ways]
        known = [moment.scores.taken(moment.measured) for moment in now]
        rmse = np.array([float(mean_or_nan(s.error**2) ** 0.5) for s in known])
        cover = np.array([mean_or_nan(s.covered) for s in known])
        every = join_scores([moment.scores for moment in now])
        pure = [moment.scores.taken(moment.measured & moment.one_surface) for moment in now]
        border = [moment.scores.taken(moment.measured & ~moment.one_surface) for moment in now]
        out |= {f"{prefix}.rmse.{name}": rmse.mean(), f"{prefix}.rmse.{name}.worst": rmse.max()}
        out |= {
            f"{prefix}.rmse.{name}.spread": rmse.std(),
            f"{prefix}.coverage90.measured.{name}": cover.mean(),
        }
        out |= {f"{prefix}.coverage90.measured.{name}.worst": _farthest_coverage(cover)}
        out |= {
            f"{prefix}.coverage90.{kind}.{name}": mean_or_nan(join_scores(of).covered)
            for kind, of in (("one_surface", pure), ("border", border))
        }
        out |= {f"{prefix}.false_grip.{name}": false_grip(join_scores(known))}
        out |= {f"{prefix}.false_ice.{name}": false_ice(join_scores(known))}
        out |= {f"{prefix}.crps.{name}": mean_or_nan(every.crps)}
        out |= {f"{prefix}.interval_score.{name}": mean_or_nan(every.interval)}
        out |= {
            f"{prefix}.slippery.{of}.{name}": value
            for of, value in slippery_scores([every]).items()
        }
    last = [way[-1].scores for way in ways]
    out |= {
        f"{prefix}.coverage90.{surface}": share
        for surface, share in by_surface(join_scores(last)).items()
    }
    out |= {f"{prefix}.slippery.{of}": value for of, value in slippery_scores(last).items()}
    return out | {f"{prefix}.crps": mean_or_nan(join_scores(last).crps)}


def _farthest_coverage(cover: FloatArray) -> float:
    return float(cover[np.argmax(np.abs(cover - MIDDLE))])
