"""The friction mixture as a bank's kernel, and what it tells."""

from __future__ import annotations

import math

from edge_agent.estimators.bank import EstimatorBank
from edge_agent.estimators.estimates import FOUR_FRICTIONS, Y
from edge_agent.estimators.friction_mixture.advance import Design, Scratch, step, velocity
from edge_agent.estimators.friction_mixture.arrays import clear, put
from edge_agent.estimators.friction_mixture.constants import NODES, C, X
from edge_agent.estimators.friction_mixture.memory import H, Memory, new_filters
from edge_agent.estimators.friction_mixture.nodes import evidence as evidence_of
from edge_agent.estimators.friction_mixture.nodes import projected, quantile
from edge_agent.estimators.friction_mixture.sample import UNKNOWN_VX_STD
from schemas.mugrid import CENTRES
from schemas.numeric import BoolArray, FloatArray
from schemas.runtime.jit import compiled, nogil
from schemas.runtime.records import Records, put_record, records

SLOWEST_M_S = 0.5  # sideslip is taken against at least this speed
YAW_RATE_OFFSET_STD = 0.001  # [rad/s]


class Desk:
    """What the filters of a thread share."""

    design: Design
    scratch: Scratch


def mixture_bank(rows: FloatArray, design: Design) -> EstimatorBank:
    """Friction mixtures of vehicles with parameters `rows` (N, 12)."""
    desk = records(Desk, 1)
    put_record(desk["design"][0], design)
    return EstimatorBank(new_filters(rows), desk, _advance, tells=FOUR_FRICTIONS, evidence=True)


@nogil
def _advance(
    filters: Records[Memory], desks: Records[Desk], t: FloatArray, signals: FloatArray, tolds: FloatArray,
    closes: BoolArray, evidence: FloatArray, share: int, first: int, last: int,
) -> None:  # fmt: skip
    desk = desks[share]
    design, scratch = desk.design, desk.scratch
    for n in range(first, last):
        memory = filters[n]
        for k in range(t.shape[0]):
            if closes.shape[0] > 0 and closes[k, n]:
                close_visit(memory, design, scratch, evidence[k, n])
            memory.held[H.LOG_LIKELIHOOD] = 0.0
            told = tolds[k, n]
            health = step(memory, design, scratch, memory.row, t[k, n], signals[k, n])
            report(memory, design, told)
            tell_wheels(memory, design, told)
            told[Y.HEALTH] = health | int(memory.held[H.HEALTH])


@compiled
def close_visit(memory: Memory, design: Design, scratch: Scratch, evidence: FloatArray) -> None:
    """Write what the visit that ends told (32,), and begin the next from the prior."""
    if not memory.started:
        clear(evidence)
        return
    if memory.held[H.UNLIKE] > 0.0:
        told, expected = scratch.predicted[:NODES], scratch.plain[:NODES]
        projected(memory.visit, design.sides.share[2], told)
        projected(design.sides.prior, design.sides.share[2], expected)
        evidence_of(design.mu, expected, told, CENTRES, evidence)
        put(memory.visit, design.sides.prior)
    else:
        evidence_of(design.mu, design.prior, memory.visit[:NODES], CENTRES, evidence)
        put(memory.visit[:NODES], design.prior)


@compiled
def tell_wheels(memory: Memory, design: Design, told: FloatArray) -> None:
    """Median, lower and upper friction of the four wheels."""
    held = memory.held
    for wheel in range(4):
        place = H.LEFT if wheel % 2 == 0 else H.RIGHT
        for k, level in enumerate((0.5, 0.05, 0.95)):
            told[Y.WHEELS + 3 * wheel + k] = (
                held[place + k] if memory.started else quantile(design.mu, design.prior, design.prior, level)
            )


@compiled
def report(memory: Memory, design: Design, told: FloatArray) -> None:
    """Write what the vehicle's filter says now, but for wheels and health."""
    if not memory.started:
        unknown(told, design)
        return
    held = memory.held
    vx, vy = velocity(memory)
    std_x = memory.all_covariance[X.VX, X.VX] + (design.constants[C.RADIUS_STD] * vx) ** 2
    std_y = memory.all_covariance[X.VY, X.VY]
    speed = max(abs(vx), SLOWEST_M_S)
    told[Y.VX], told[Y.VY], told[Y.YAW_RATE], told[Y.SIDESLIP] = vx, vy, held[H.YAW_RATE], math.atan2(vy, speed)
    told[Y.VX_STD], told[Y.VY_STD] = math.sqrt(std_x), math.sqrt(std_y)
    told[Y.YAW_RATE_STD] = math.sqrt(held[H.YAW_RATE_VAR] + YAW_RATE_OFFSET_STD**2)
    told[Y.SIDESLIP_STD] = math.sqrt(std_y + (vy / speed) ** 2 * std_x) / speed
    told[Y.MU], told[Y.MU_LOWER], told[Y.MU_UPPER] = held[H.MU], held[H.MU_LOWER], held[H.MU_UPPER]
    told[Y.MU_UTILISED], told[Y.INNOVATION_NIS] = held[H.USED], held[H.NIS]
    told[Y.ADAPTATION] = max(memory.factor[0], memory.factor[1])
    told[Y.INNOVATION_LOG_LIKELIHOOD] = held[H.LOG_LIKELIHOOD]


@compiled
def unknown(told: FloatArray, design: Design) -> None:
    """What is said before the first usable sample: the prior, and no motion with a wide spread."""
    told[Y.VX] = told[Y.VY] = told[Y.YAW_RATE] = told[Y.SIDESLIP] = 0.0
    told[Y.VX_STD] = UNKNOWN_VX_STD
    told[Y.VY_STD] = told[Y.YAW_RATE_STD] = told[Y.SIDESLIP_STD] = 1.0
    told[Y.MU] = quantile(design.mu, design.prior, design.prior, 0.5)
    told[Y.MU_LOWER] = quantile(design.mu, design.prior, design.prior, 0.05)
    told[Y.MU_UPPER] = quantile(design.mu, design.prior, design.prior, 0.95)
    told[Y.MU_UTILISED] = told[Y.INNOVATION_NIS] = told[Y.INNOVATION_LOG_LIKELIHOOD] = 0.0
    told[Y.ADAPTATION] = 1.0
