"""Conversion of received DENM (standard messages of vehicles and road operators about hazards) to
friction reports. All DENM from one interchange (server that distributes such messages) are
converted to reports of one made-up vehicle. The fusion, which computes the map from all reports,
learns the trust in this vehicle as in a real one. Pure (no I/O).

An alert needs reports of at least two vehicles, so DENM of one interchange alone cannot raise an
alert.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from typing import Any, Final

from fleet_service.client.cits.denm import ADHESION, BLACK_ICE, HEAVY_FROST, ICE, SALTED, SNOW, Denm
from schemas import grid, keys
from schemas.thresholds import NS

# Median and bounds of the friction that a sub-cause stands for. Snow and ice have the ranges of
# `thresholds.SURFACES`, as in our own DENM. Frost and unknown causes have wider ones. A salted road
# is no warning of low friction.
GRIP: Final = {
    HEAVY_FROST: (0.3, 0.15, 0.45),
    SNOW: (0.3, 0.2, 0.45),
    ICE: (0.12, 0.05, 0.2),
    BLACK_ICE: (0.12, 0.05, 0.2),
}
UNKNOWN: Final = (0.35, 0.15, 0.6)
USED: Final = 0.6  # assumed use as a share of the median; with less, the report would be a bound
WORST_STD: Final = 12.0  # [m] largest position error with which a cell can be identified
MOST_CELLS: Final = 24  # limit of cells, so that both directions fit into one batch
QUARTERS: Final = (0.0, 90.0, 180.0, 270.0)  # [deg] headings of the four sectors
POSITION_STD: Final = 10.0  # [m] used if the message states no accuracy


def encode_reports(
    denm: Denm, name: str, boot: int, first_seq: int, now: int
) -> list[tuple[str, bytes]]:
    """Return keys and JSON payloads of the batches of reports that stand for a DENM (hazard
    message); empty if it says nothing about friction at present.

    Args:
        denm: received message.
        name: vehicle name for the reports.
        boot: random number that identifies this start of the gateway.
        first_seq: sequence number of the first batch.
        now: current time [ns UTC].
    """
    if not _is_grip_report(denm, now):
        return []
    mu, lower, upper = GRIP.get(denm.sub_cause, UNKNOWN)
    rows_of: dict[int, list[tuple[float, float, float]]] = {}
    for point in _event_places(denm):
        rows = rows_of.setdefault(int(grid.region_of(int(grid.cell_of(*point)))), [])
        rows += [(*point, heading) for heading in _headings(denm)]
    out: list[tuple[str, bytes]] = []
    for seq, (region, rows) in enumerate(rows_of.items(), first_seq):
        count = len(rows)
        batch: dict[str, Any] = {
            "vehicle": name,
            "boot": str(boot),
            "seq": str(seq),
            # All regions share the numbers of one start. No batch is sent again, so none is held.
            "first_held": str(seq),
            "enter_time": [str(min(denm.referenced, now))] * count,
            "latitude": [row[0] for row in rows],
            "longitude": [row[1] for row in rows],
            "yaw": [math.radians(90.0 - row[2]) for row in rows],
            "position_std": [denm.position_std if denm.position_std > 0.0 else POSITION_STD]
            * count,
            "mu": [mu] * count,
            "mu_lower": [lower] * count,
            "mu_upper": [upper] * count,
            "mu_utilised": [USED * mu] * count,
        }
        out.append((keys.observation_key(region, name), json.dumps(batch).encode()))
    return out


def _headings(denm: Denm) -> tuple[float, ...]:
    """Return the headings [deg from north] of the traffic that a DENM concerns.

    If the DENM states no heading, return both directions of the road. The direction of the road is
    estimated by the line between the event and another position in the message. This position is
    the first one that differs from the event's position, searched in two lists: the traces (paths
    that lead to the event), then the history (further points of the event). If there is no such
    position, return north, east, south and west.
    """
    if denm.heading is not None:
        return (denm.heading, denm.heading + 180.0) if denm.both_ways else (denm.heading,)
    for point in (*(point for trace in denm.traces for point in trace), *denm.history):
        north = denm.position[0] - point[0]
        east = (denm.position[1] - point[1]) * math.cos(math.radians(denm.position[0]))
        if north or east:
            axis = math.degrees(math.atan2(east, north))
            return axis, axis + 180.0
    return QUARTERS


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
