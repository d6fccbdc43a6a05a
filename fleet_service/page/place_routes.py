"""HTTP routes of one place: a cell with its history, the stored moments, and a route."""

from __future__ import annotations

from typing import Any

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from fleet_service.page import request_params, route
from fleet_service.page.sources import Handlers, Sources
from schemas import grid, keys
from schemas.thresholds import NS


class PlaceRoutes:
    """Request handlers for a cell or a route that a person selects."""

    def __init__(self, sources: Sources) -> None:
        self._of = sources

    def paths(self) -> Handlers:
        """Return the request handlers by URL path."""
        return {
            "/cell/{cell}/{sector}": self.cell,
            "/history/{cell}/{sector}": self.history,
            "/moments": self.times,
            "/route": self.route,
        }

    async def cell(self, request: Request) -> Response:
        """Return the present values of the cell and heading sector that a request names."""
        cell, sector = request_params.parse_place(request)
        return JSONResponse(await run_in_threadpool(self._cell, cell, sector))

    def _cell(self, cell: int, sector: int) -> dict[str, Any] | None:
        box = ",".join(f"{side:.9f}" for side in (float(edge) for edge in grid.bounds(cell)))
        for _, table in self._of.reader.ask(keys.map_key(int(grid.tile_of(cell))), {"bbox": box}):
            for row in table.to_pylist():
                if row["cell"] == cell and row["sector"] == sector:
                    measured = row["basis"] == "measured"
                    speeds = route.safe_speeds(row["mu_lower"]) if measured else None
                    times = {name: row[name].value / NS for name in ("first_time", "last_time")}
                    return row | times | {"cell": str(cell), "safe_speed": speeds}
        return None

    async def history(self, request: Request) -> Response:
        """Return the belief (mu with its interval and P(slippery)) about a cell at each past moment
        of which the map is stored.
        """
        return JSONResponse(
            await run_in_threadpool(self._of.moments.history, *request_params.parse_place(request))
        )

    async def times(self, _: Request) -> Response:
        """Return the past moments of which the map is stored [s since 1970]."""
        return JSONResponse(await run_in_threadpool(self._of.moments.times))

    async def route(self, request: Request) -> Response:
        """Return the friction along the route that the parameter `points` describes."""
        points, text = request_params.parse_route(request)
        return JSONResponse(await run_in_threadpool(self._profile, points, text))

    def _profile(self, points: list[tuple[float, float]], text: str) -> dict[str, Any]:
        import pyarrow as pa

        from schemas.tables import MAP_SCHEMA

        replies = [
            table for _, table in self._of.reader.ask(f"{keys.ROOT}/map/**", {"route": text})
        ]
        return route.grip_profile(
            points, pa.concat_tables(replies) if replies else MAP_SCHEMA.empty_table()
        )
