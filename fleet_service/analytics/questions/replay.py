"""`replay`: the map at any past moment, replayed from the archive; or a period as a sequence of
frames (maps of successive moments).
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import pyarrow as pa

from fleet_service.analytics.engines import QueryEngine
from fleet_service.analytics.options import Options
from fleet_service.analytics.past_map import visited_cells
from fleet_service.archive.format import layout
from fleet_service.fusion import Fusion
from fleet_service.replay.rebuild import Since, fusion_with_weather, replay
from schemas import tables
from schemas.errors import InputError
from schemas.thresholds import NS, US_STEP
from schemas.wire import Kind

MOST_FRAMES: Final = 1500  # largest number in an answer: one day with one frame per minute
LEAST_STEP_S: Final = 1.0
REPORT_ROWS: Final = 1_000_000  # number of rows between two progress messages


def ask(engine: QueryEngine, options: Options) -> pa.Table:
    """Return a table of the map's cells at the time `options.at`. If `options.step_s` is given,
    return instead the cells of each frame (the map at one moment) during the selected period; the
    column `frame` contains the time of the frame.

    Raises:
        InputError: the step is not valid, or makes too many frames.
    """
    if options.step_s is not None and not LEAST_STEP_S <= options.step_s < math.inf:
        raise InputError(
            "step",
            f"{options.step_s:g} s is not a valid step",
            "give the time between two frames in seconds, e.g. 600",
        )
    at = options.at if options.at is not None else engine.extract.until
    fusion = fusion_with_weather(engine.root, options.lateness_s, at)
    if options.step_s is None:
        rows = 0
        for updated in replay(engine.root, fusion, Since(until=at, box=engine.extract.bbox)):
            rows += len(updated.late)
            if rows // REPORT_ROWS > (rows - len(updated.late)) // REPORT_ROWS:
                options.report(f"{rows:,} observations replayed, {fusion.size:,} cells")
        return _map_frame(engine, fusion, at)
    step = int(options.step_s * NS)
    due = None
    frames = []
    for updated in replay(
        engine.root, fusion, Since(until=engine.extract.until, box=engine.extract.bbox)
    ):
        if not len(updated.slots):
            continue
        now = int(fusion.live.time[updated.slots].max())
        if due is None:
            due = _frames_begin(engine, int(fusion.live.time[updated.slots].min()), step)
        while due + step <= now:
            due += step
            frames.append(_map_frame(engine, fusion, due))
            options.report(
                f"frame {np.datetime64(due, 'ns').astype('datetime64[s]')}: {frames[-1].num_rows} "
                "cells"
            )
    return pa.concat_tables([*frames, _map_frame(engine, fusion, engine.extract.until)])


def _frames_begin(engine: QueryEngine, first: int, step: int) -> int:
    """Return the time of the first frame [ns]: the begin of the selected part, or the time of the
    first row (`first` [ns]) rounded down to a multiple of `step` [ns], whichever is later.

    Raises:
        InputError: there would be too many frames.
    """
    days = layout.day_folders(engine.root, layout.TABLES[Kind.OBSERVATION])
    last = (max(map(layout.day_of, days), default=first // layout.DAY_NS) + 1) * layout.DAY_NS
    begin = max(engine.extract.since, first - first % step)
    frames = (min(engine.extract.until, max(last, first)) - begin) // step
    if frames > MOST_FRAMES:
        problem = (
            f"makes {frames} frames from {np.datetime64(begin, 'ns').astype('datetime64[s]')} on"
        )
        raise InputError(
            "step",
            problem,
            f"give a longer step, or --from and --to; the limit is {MOST_FRAMES} frames",
        )
    return begin


def _map_frame(engine: QueryEngine, fusion: Fusion, at: int) -> pa.Table:
    table = visited_cells(fusion, at, engine.extract.bbox)
    frame = pa.array(np.full(table.num_rows, at // US_STEP)).cast(tables.US)
    return table.append_column("frame", frame)
