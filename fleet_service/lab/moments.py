"""Whole ways with the real estimator, judged while they go on: after one, six and thirty minutes, the worst of all.

A map that is right after a minute may become too sure of what all vehicles err in alike, and one that is right after
half an hour may have said too much in the first minute. So each way is asked at MOMENTS, and what counts is the worst.
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
from fleet_service.lab.score import Scores, by_surface, calibration, joined, of_beliefs, worst_bin
from fleet_service.serve.view import LOWER, UPPER, is_measured
from schemas import mugrid
from schemas.numeric import BoolArray, FloatArray
from schemas.thresholds import NS

MOMENTS: Final = (60.0, 360.0, 1800.0)  # [s] after the first observation
MIDDLE: Final = 0.91  # of the bar on coverage: the worst is the farthest from it


class AskedWay(NamedTuple):
    """Scores of the cells that several vehicles visited until then, and which of them are measured."""

    scores: Scores
    measured: BoolArray


def moments(folder: Path) -> list[AskedWay]:
    """What a map made of a way says at MOMENTS, as far as it lasts."""
    o = end_to_end.observations_in(end_to_end.read(folder / OBSERVATIONS))
    visits, begin = pq.read_table(folder / TRUTH), int(o.time.min())
    left = visits["leave_time"].cast(pa.int64())
    fusion, taken, out = Fusion(LATENESS_S), begin - 1, []
    for seconds in MOMENTS:
        until = begin + int(seconds * NS)
        rows = np.flatnonzero((o.time > taken) & (o.time <= until))
        if not len(rows):
            break
        end_to_end.raised_alerts(fusion, o.take(rows))
        past, taken = visits.filter(pc.less_equal(left, pa.scalar(until))), until
        slots, truth = end_to_end.joined(fusion, past)
        several = fusion.live.vehicles[slots] >= SEVERAL
        slots, truth = slots[several], truth[several]
        belief = fusion.beliefs(slots, until)
        lower, upper = (mugrid.quantiles(belief, q) for q in (LOWER, UPPER))
        scores = of_beliefs(belief, truth, end_to_end.excited(fusion, past)[slots])
        out.append(AskedWay(scores, is_measured(lower, upper, fusion.live.values[slots])))
    return out


def figures(ways: Sequence[Sequence[AskedWay]], prefix: str) -> dict[str, float]:
    """The worst of all ways and moments; of each moment the worst, the mean and the spread over the ways."""
    out: dict[str, float] = {}
    rmse, cover, score = (
        np.array([[of(moment) for moment in way] for way in ways]) for of in (_rmse, _coverage, _interval)
    )
    for k, seconds in enumerate(MOMENTS[: rmse.shape[1]]):
        name = f"after{seconds / 60.0:.0f}"
        out |= {f"{prefix}.rmse.{name}": rmse[:, k].max(), f"{prefix}.rmse.{name}.mean": rmse[:, k].mean()}
        out |= {f"{prefix}.rmse.{name}.spread": rmse[:, k].std(), f"{prefix}.coverage90.{name}": _farthest(cover[:, k])}
        out |= {
            f"{prefix}.coverage90.{name}.mean": cover[:, k].mean(),
            f"{prefix}.interval_score.{name}": score[:, k].max(),
        }
    last = [way[-1].scores for way in ways]
    out |= {f"{prefix}.coverage90.{surface}": share for surface, share in by_surface(joined(last)).items()}
    return out | {
        f"{prefix}.rmse": rmse.max(), f"{prefix}.coverage90": _farthest(cover.ravel()),
        f"{prefix}.worst_bin": worst_bin(calibration(last)), f"{prefix}.ways": float(len(ways)),
    }  # fmt: skip


def _rmse(moment: AskedWay) -> float:
    return float(end_to_end.mean(moment.scores.error[moment.measured] ** 2) ** 0.5)


def _coverage(moment: AskedWay) -> float:
    return end_to_end.mean(moment.scores.covered)


def _interval(moment: AskedWay) -> float:
    return end_to_end.mean(moment.scores.interval)


def _farthest(cover: FloatArray) -> float:
    return float(cover[np.argmax(np.abs(cover - MIDDLE))])
