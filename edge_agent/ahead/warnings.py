"""Warnings about slippery stretches of road. A warning is issued when a stretch comes within reach,
updated when the stretch changes, and ended when the stretch is no longer ahead or no longer
slippery. The module is pure (no I/O).

The reach is the distance that the car needs to stop before the stretch. It consists of the distance
during the driver's reaction, a margin, and braking with the lower end of the friction interval.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from edge_agent.ahead.horizon import MARGIN_M, Horizon, braking_from, justifies_warning
from edge_agent.ahead.local_map import MEASURED, LocalMap
from edge_agent.ahead.path import Pose
from schemas import grid
from schemas.numeric import BoolArray
from schemas.thresholds import NS, REACTION_S
from schemas.wire.ahead import GripWarning, WarningState

# [s] time between two look-ups, during which the car comes nearer without a warning
UPDATE_S: Final = 1.0
GAIN: Final = 3.0  # [m/s] speed that a car may gain until the next look-up, at 3 m/s^2
LINK_M: Final = 30.0  # [m] slippery stretches with a smaller gap are joined
# [s] time for which a stretch may be missing from the horizons before its warning ends, because
# positions jump.
ABSENT_S: Final = 2.0
# [m] A car counts as having passed a stretch if the stretch disappears from the horizons at a
# smaller distance.
NEAR_M: Final = 30.0
CHANGED_MU: Final = 0.05  # change of the friction from which a warning is updated
CHANGED_PLACES: Final = 2  # number of new places from which a warning is updated
SLOWEST: Final = 0.5  # [m/s] at lower speeds a warning contains no time to the stretch


@dataclass(frozen=True)
class Active:
    """Current warning about a slippery stretch of road: the warning as last reported, the stretch's
    places (cell·4 + sector), and the time [ns UTC] and distance [m] at which the stretch was last
    seen ahead.
    """

    warning: GripWarning
    places: frozenset[int]
    last_seen: int
    distance_m: float


@dataclass(frozen=True)
class _Stretch:
    places: frozenset[int]
    start: float
    end: float
    worst: int
    # [m^2/s^2] half the square of the speed that the car can brake away before the stretch
    braking_energy: float
    horizon: Horizon


def update_warnings(
    active: tuple[Active, ...], horizons: list[Horizon], pose: Pose, known: LocalMap
) -> tuple[tuple[Active, ...], list[GripWarning]]:
    """Update the active warnings from new horizons (values of the map for each metre ahead). Return
    the active warnings after the update, and the warnings to report now (raised, updated or ended).

    Args:
        active: active warnings before the update.
        horizons: horizons of all possible paths, the most likely first.
        pose: position, heading, speed and time of the car.
        known: the local copy of the map in the car.
    """
    issued: list[GripWarning] = []
    speed = pose.speed + GAIN if pose.speed > SLOWEST else 0.0
    stretches = [stretch for horizon in horizons for stretch in _slippery_stretches(horizon, speed)]
    current: dict[str, Active] = {one.warning.id: one for one in active}
    here: set[str] = set()  # names of the warnings whose stretches lie ahead now
    for places, ways in _by_place(stretches):
        nearest = min(ways, key=lambda stretch: stretch.start)
        before = next((one for one in current.values() if one.places & places), None)
        sure = len({id(way.horizon) for way in ways}) == len(horizons)
        if before is None:
            if nearest.braking_energy > 0.5 * speed**2:
                continue
            warning = _make_warning(_new_name(nearest, pose), "raised", nearest, pose, sure=sure)
            issued.append(warning)
            current[warning.id] = Active(warning, places, pose.time, nearest.start)
        else:
            warning = _make_warning(before.warning.id, "updated", nearest, pose, sure=sure)
            has_grown = len(places - before.places) >= CHANGED_PLACES
            if has_grown or abs(warning.mu - before.warning.mu) >= CHANGED_MU:
                issued.append(warning)
                places |= before.places
                current[warning.id] = Active(warning, places, pose.time, nearest.start)
            else:
                current[warning.id] = replace(before, last_seen=pose.time, distance_m=nearest.start)
        here.add(warning.id)
    for name, last in list(current.items()):
        if name in here:
            continue
        stands = justifies_warning(known.look_up(np.array(sorted(last.places)), pose.time)).any()
        if not stands or pose.time - last.last_seen > ABSENT_S * NS:
            issued.append(_end_warning(last, pose, stands=bool(stands)))
            del current[name]
    return tuple(current.values()), issued


def _slippery_stretches(horizon: Horizon, speed: float) -> list[_Stretch]:
    """Return the slippery stretches of a horizon (map values for each metre ahead). Stretches at
    most LINK_M metres apart are joined.
    """
    brakes = np.concatenate([[0.0], braking_from(horizon)])
    # Metre at which the car begins to brake at the latest.
    begins = math.ceil(speed * (REACTION_S + UPDATE_S) + MARGIN_M)
    found = []
    for first, last in _find_runs(horizon.slippery):
        places = frozenset(
            horizon.key[first : last + 1][horizon.slippery[first : last + 1]].tolist()
        )
        worst = first + int(
            np.nanargmin(np.where(horizon.slippery, horizon.mu, np.nan)[first : last + 1])
        )
        braking_energy = float(brakes[first] - brakes[min(begins, first)])
        found.append(
            _Stretch(places, float(first), float(last + 1), worst, braking_energy, horizon)
        )
    return found


def _find_runs(mask: BoolArray) -> list[tuple[int, int]]:
    at = np.flatnonzero(mask)
    if not len(at):
        return []
    breaks = np.flatnonzero(np.diff(at) > LINK_M)
    return list(
        zip(
            at[np.append(0, breaks + 1)].tolist(),
            at[np.append(breaks, len(at) - 1)].tolist(),
            strict=True,
        )
    )


def _by_place(stretches: list[_Stretch]) -> list[tuple[frozenset[int], list[_Stretch]]]:
    """Group slippery stretches of several possible paths: stretches that share a place (one map
    cell and heading sector) belong to one group. Return a pair per group: all its places, and all
    its stretches.
    """
    groups: list[tuple[frozenset[int], list[_Stretch]]] = []
    for stretch in stretches:
        same = [group for group in groups if group[0] & stretch.places]
        groups = [group for group in groups if not group[0] & stretch.places]
        places = stretch.places.union(*(group[0] for group in same))
        groups.append((places, [*(way for group in same for way in group[1]), stretch]))
    return groups


def _new_name(stretch: _Stretch, pose: Pose) -> str:
    """Return a name for the warning of a stretch: the quadkey and the sector of its first place,
    and the time.
    """
    first = min(stretch.places)
    cell = grid.quadkey(first // grid.SECTORS, grid.CELL_ZOOM)
    return f"{cell}{first % grid.SECTORS}-{pose.time // NS:x}"


def _make_warning(
    name: str, state: WarningState, stretch: _Stretch, pose: Pose, *, sure: bool
) -> GripWarning:
    horizon = stretch.horizon
    k = stretch.worst
    first = int(stretch.start)
    last = int(stretch.end)
    age = float(np.nanmin(horizon.age_s[first:last]))
    alerted = horizon.alerted[first:last]
    if (alerted & (horizon.basis[first:last] == MEASURED)).any():
        reason = "an alert is active"
    elif alerted.any():
        reason = "an alert is active for the opposite direction"
    else:
        reason = "the map reports low grip"
    return GripWarning(
        id=name,
        state=state,
        time=pose.time,
        distance_m=stretch.start,
        length_m=stretch.end - stretch.start,
        time_s=stretch.start / pose.speed if pose.speed > SLOWEST else math.inf,
        mu=float(horizon.mu[k]),
        mu_lower=float(horizon.mu_lower[k]),
        p_slippery=float(horizon.p_slippery[k]),
        age_s=age,
        safe_speed=float(np.nanmin(horizon.safe_speed[first:last])),
        way=horizon.path.kind,
        sure=sure,
        reason=reason,
    )


def _end_warning(one: Active, pose: Pose, *, stands: bool) -> GripWarning:
    if not stands:
        reason = "the map no longer reports the stretch as slippery"
    elif one.distance_m <= NEAR_M:
        reason = "passed"
    else:
        reason = "the vehicle left this route"
    return replace(one.warning, state="ended", time=pose.time, reason=reason)
