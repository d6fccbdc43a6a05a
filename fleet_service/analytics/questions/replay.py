"""`replay`: the map as of any moment, replayed from the archive as the service fused it; or a day of it, in frames."""

from __future__ import annotations

from typing import Final

import numpy as np
import pyarrow as pa

from fleet_service.analytics.engines import QueryEngine
from fleet_service.analytics.options import Options
from fleet_service.fusion import Fusion
from fleet_service.ingest.weather import archived
from fleet_service.replay.rebuild import Since, replay
from fleet_service.serve.encode import cell_table
from schemas import grid, tables
from schemas.thresholds import NS

REPORT_ROWS: Final = 1_000_000  # between two lines of progress


def ask(engine: QueryEngine, options: Options) -> pa.Table:
    """Cells of the map at `at`, or of each frame from the part's begin to its end; `frame` is its time."""
    at = options.at if options.at is not None else engine.part.until
    fusion = Fusion(options.lateness_s)
    fusion.update_weather(archived(engine.root, received_until=max(at, engine.part.until) if options.step_s else at))
    if not options.step_s:
        rows = 0
        for updated in replay(engine.root, fusion, Since(until=at, box=engine.part.bbox)):
            rows += len(updated.late)
            if rows // REPORT_ROWS > (rows - len(updated.late)) // REPORT_ROWS:
                options.report(f"{rows:,} observations replayed, {fusion.size:,} cells")
        return _frame(engine, fusion, at)
    step, due, frames = int(options.step_s * NS), engine.part.since, []
    for updated in replay(engine.root, fusion, Since(until=engine.part.until, box=engine.part.bbox)):
        now = int(fusion.live.time[updated.slots].max(initial=0))
        while due + step <= now:
            due += step
            frames.append(_frame(engine, fusion, due))
            options.report(f"frame {np.datetime64(due, 'ns').astype('datetime64[s]')}: {frames[-1].num_rows} cells")
    return pa.concat_tables([*frames, _frame(engine, fusion, engine.part.until)])


def _frame(engine: QueryEngine, fusion: Fusion, at: int) -> pa.Table:
    slots = np.flatnonzero(fusion.live.vehicles[: fusion.size] > 0)  # a poor fix makes neighbours that nobody visited
    if engine.part.bbox is not None:
        west, south, east, north = grid.bounds(fusion.cell[slots])
        box = engine.part.bbox
        slots = slots[(east > box[0]) & (north > box[1]) & (west < box[2]) & (south < box[3])]
    table = cell_table(fusion, slots, at)
    frame = pa.array(np.full(table.num_rows, at // tables.US_STEP)).cast(tables.US)
    return table.append_column("frame", frame)
