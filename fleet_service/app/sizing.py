"""Sizing of a deployment: processor cores, memory, disk and network for a fleet. The estimate uses
measured costs per vehicle, cell, pair of vehicle and cell, and observation.

The costs of processor, network and disk come from `make country-bench` (100 000 vehicles for ten
minutes on two cores). The costs of memory are fitted to the measured memory of engines (services
without network) with 10⁴ to 10⁵ vehicles. `make bench ONLY=sizing` checks the fit: it measures the
memory for 10⁴ and for 10⁵ vehicles again.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

from fleet_service.fusion.constants import FORGOTTEN_EVERY_S, FORGOTTEN_S, VOTE_RENEWAL_S
from schemas import grid
from schemas.thresholds import EARTH_RADIUS_M

_DAY_S: Final = 86_400.0
_USED: Final = 0.6  # largest planned load of a core, so that a service can catch up after an outage
# [m] edge of a cell at the equator
_CELL_M: Final = 2.0 * math.pi * EARTH_RADIUS_M / (1 << grid.CELL_ZOOM)
# Number of cells that a road of random direction touches, per edge length of a cell.
_DIAGONAL: Final = 4.0 / math.pi
_DIRECTIONS: Final = 2
_EPOCH_S: Final = 60.0  # [s] the checkpoint advances in steps of this length


class Costs(NamedTuple):
    """Measured costs of a fleet service.

    Attributes:
        process_bytes: memory of a service without data.
        vehicle_bytes, cell_bytes, pair_bytes: memory per vehicle; per cell and sector; per pair of
            a vehicle and a cell that it visited lately.
        waiting_bytes: memory per observation in the lateness window (the last minutes, whose
            observations are kept so that delayed ones can be sorted in by time).
        window_bytes: additional memory per cell and sector with such observations.
        service_s: processor time of a service per observation [s].
        router_s: processor time of a router per message [s].
        wire_bytes: bytes of an observation on the network.
        archive_bytes: bytes of an observation in the compacted archive.
        values: share of the visits that give a value of friction and not only a lower bound.
    """

    process_bytes: float
    vehicle_bytes: float
    cell_bytes: float
    pair_bytes: float
    waiting_bytes: float
    window_bytes: float
    service_s: float
    router_s: float
    wire_bytes: float
    archive_bytes: float
    values: float


COSTS: Final = Costs(
    process_bytes=260e6,
    vehicle_bytes=2480.0,
    cell_bytes=170.0,
    pair_bytes=12.0,
    waiting_bytes=155.0,
    window_bytes=450.0,
    service_s=79e-6,
    router_s=49e-6,
    wire_bytes=130.0,
    archive_bytes=40.0,
    values=0.15,  # .14 to .17 in four complete end-to-end drives of the lab
)


class MemoryContent(NamedTuple):
    """Content of a service's memory: numbers of vehicles, of cells (counted once per heading
    sector), of pairs of a vehicle and a cell that it visited lately, and of observations in the
    lateness window (the last minutes, whose observations are kept to sort in delayed ones by time).
    """

    vehicles: float
    cells: float
    pairs: float
    waiting: float


class PlannedFleet(NamedTuple):
    """A fleet and the roads on which it drives.

    Attributes:
        vehicles: number of vehicles on the road at the same time.
        rate_hz: observations per second of each vehicle; one per visited cell.
        cells: number of cells (counted once per heading sector) of all roads.
        message_rows: observations per message.
        lateness_s: allowed delay of observations [s], a setting of the service. The service keeps
            all observations of this period in memory, so that it can sort delayed ones.
    """

    vehicles: float
    rate_hz: float
    cells: float
    message_rows: float = 10.0
    lateness_s: float = 120.0


class DeploymentSize(NamedTuple):
    """Size of a deployment. `services` is the number of services that are needed so that each uses
    at most 60 % of a core. `memory_bytes` is the memory of all services together, and `parts_bytes`
    is its share for each kind of content.
    """

    observations_per_s: float
    service_cores: float
    services: int
    router_cores: float
    memory_bytes: float
    parts_bytes: dict[str, float]
    archive_bytes_per_day: float
    network_bytes_per_s: float


def estimate_size(fleet: PlannedFleet) -> DeploymentSize:
    """Return the size of a deployment for a fleet. The estimate assumes that no vehicle visits a
    cell twice within hours. Its number of pairs of vehicle and cell is therefore an upper limit.
    """
    rate = fleet.vehicles * fleet.rate_hz
    costs = COSTS
    pairs = remembered_pairs(rate, costs.values)
    waiting = rate * (fleet.lateness_s + _EPOCH_S / 2)
    parts = split_memory(MemoryContent(fleet.vehicles, fleet.cells, pairs, waiting), costs)
    cores = rate * costs.service_s
    services = max(math.ceil(cores / _USED), 1)
    parts["processes"] = services * costs.process_bytes
    return DeploymentSize(
        observations_per_s=rate,
        service_cores=cores,
        services=services,
        router_cores=rate / fleet.message_rows * costs.router_s,
        memory_bytes=sum(parts.values()),
        parts_bytes=parts,
        archive_bytes_per_day=rate * _DAY_S * costs.archive_bytes,
        network_bytes_per_s=rate * costs.wire_bytes,
    )


def remembered_pairs(rate: float, values: float) -> float:
    """Return the number of pairs of a vehicle and a cell that the fusion (beliefs about the
    friction of all cells) keeps in memory, if no vehicle visits a cell twice.

    Args:
        rate: observations per second.
        values: share of these observations that give a value of friction and not only a lower
            bound.
    """
    bounds = 1.0 - values
    return rate * (values * FORGOTTEN_S + bounds * VOTE_RENEWAL_S + FORGOTTEN_EVERY_S / 2)


def cells_of_roads(road_km: float, latitude: float) -> float:
    """Return the number of cells (counted once per heading sector, so both directions count) of
    roads of a total length [km] at a latitude [deg].
    """
    edge_m = _CELL_M * math.cos(math.radians(latitude))
    return _DIRECTIONS * _DIAGONAL * 1e3 * road_km / edge_m


def split_memory(content: MemoryContent, costs: Costs = COSTS) -> dict[str, float]:
    """Return the memory [bytes] for each part of a service's content, without the memory of a
    process that has no data.
    """
    return {
        "vehicles": content.vehicles * costs.vehicle_bytes,
        "cells": content.cells * costs.cell_bytes,
        "visits": content.pairs * costs.pair_bytes,
        "window": content.waiting * costs.waiting_bytes
        + min(content.waiting, content.cells) * costs.window_bytes,
    }
