"""Foreign DENM as reports of one witness, so that the fusion weighs and trusts them like a vehicle
of that name. Pure.

All reports of one interchange have one name. An alert needs two sources, so they raise nothing
alone.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from typing import Any, Final

from fleet_service.client.cits.denm import ADHESION, BLACK_ICE, HEAVY_FROST, ICE, SALTED, SNOW, Denm
from schemas import grid, keys
from schemas.thresholds import NS

# Friction that a sub-cause means: middle and bounds. Snow and ice as in the tyres' table of the
# simulator; frost and unknown causes between. A salted road is no warning of low friction.
GRIP: Final = {
    HEAVY_FROST: (0.3, 0.15, 0.45),
    SNOW: (0.3, 0.2, 0.45),
    ICE: (0.2, 0.08, 0.35),
    BLACK_ICE: (0.15, 0.06, 0.3),
}
UNKNOWN: Final = (0.35, 0.15, 0.6)
USED: Final = 0.6  # of the middle: with less, a report would say only "at least"
WORST_STD: Final = 30.0  # [m] of a position that names a cell at all
MOST_CELLS: Final = 24
POSITION_STD: Final = 10.0  # [m] where a message does not say


def encode_reports(
    denm: Denm, name: str, boot: int, first_seq: int, now: int
) -> list[tuple[str, bytes]]:
    """Return key and JSON of a batch for each region of an event; none if it says nothing about
    grip here and now.

    Args:
        denm: received.
        name: of the witness.
        boot: random number of this start.
        first_seq: next number of the batches.
        now: [ns UTC].
    """
    if not _is_grip_report(denm, now):
        return []
    mu, lower, upper = GRIP.get(denm.sub_cause, UNKNOWN)
    by_region: dict[int, list[tuple[float, float]]] = {}
    for point in _event_places(denm):
        by_region.setdefault(int(grid.region_of(int(grid.cell_of(*point)))), []).append(point)
    out: list[tuple[str, bytes]] = []
    for seq, (region, points) in enumerate(by_region.items(), first_seq):
        rows = len(points)
        batch: dict[str, Any] = {
            "vehicle": name,
            "boot": str(boot),
            "seq": str(seq),
            "enter_time": [str(min(denm.referenced, now))] * rows,
            "latitude": [point[0] for point in points],
            "longitude": [point[1] for point in points],
            "yaw": [math.radians(90.0 - (denm.heading or 0.0))] * rows,
            "position_std": [denm.position_std if denm.position_std > 0.0 else POSITION_STD] * rows,
            "mu": [mu] * rows,
            "mu_lower": [lower] * rows,
            "mu_upper": [upper] * rows,
            "mu_utilised": [USED * mu] * rows,
        }
        out.append((keys.observation_key(region, name), json.dumps(batch).encode()))
    return out


def _is_grip_report(denm: Denm, now: int) -> bool:
    over = now > denm.detected + denm.validity_s * NS
    vague = denm.position_std > WORST_STD or not math.isfinite(denm.position[0])
    return (
        denm.cause == ADHESION
        and denm.sub_cause != SALTED
        and denm.termination is None
        and not over
        and not vague
    )


def _event_places(denm: Denm) -> Iterable[tuple[float, float]]:
    seen: dict[int, tuple[float, float]] = {}
    for point in (denm.position, *denm.history):
        seen.setdefault(int(grid.cell_of(*point)), point)
    return list(seen.values())[:MOST_CELLS]
