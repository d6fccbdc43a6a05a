"""The estimator bank: N vehicles side by side through one compiled path.

No vehicle's numbers meet another's, and all state lies in the memory, so results are bit-equal whatever N is and
however the samples are cut into calls.
"""

from __future__ import annotations

import math
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from edge_agent.estimators.friction_mixture.advance import Design, Scratch, step, velocity
from edge_agent.estimators.friction_mixture.arrays import clear, put
from edge_agent.estimators.friction_mixture.block import F
from edge_agent.estimators.friction_mixture.constants import NODES, PAIRS, STATES, C, X
from edge_agent.estimators.friction_mixture.memory import H, Memory, new_memory
from edge_agent.estimators.friction_mixture.node import new_room
from edge_agent.estimators.friction_mixture.nodes import evidence as evidence_of
from edge_agent.estimators.friction_mixture.nodes import projected, quantile
from edge_agent.estimators.friction_mixture.residuals import ROWS
from edge_agent.estimators.friction_mixture.sample import UNKNOWN_VX_STD
from edge_agent.estimators.shares import checked, in_shares
from schemas.mugrid import BINS, CENTRES
from schemas.numeric import BoolArray, FloatArray, compiled, released

OUTPUTS = (  # the first fields of Estimates
    "vx", "vy", "yaw_rate", "sideslip", "vx_std", "vy_std", "yaw_rate_std", "sideslip_std",
    "mu", "mu_lower", "mu_upper", "mu_utilised", "innovation_nis", "adaptation", "innovation_log_likelihood",
)  # fmt: skip
FlagArray: TypeAlias = NDArray[np.int32]

SLOWEST_M_S = 0.5  # sideslip is taken against at least this speed
YAW_RATE_OFFSET_STD = 0.001  # [rad/s]


class Estimates(NamedTuple):
    """What a bank says per sample and vehicle; arrays of shape (T, N) unless said otherwise."""

    vx: FloatArray  # [m/s]
    vy: FloatArray  # [m/s]
    yaw_rate: FloatArray  # [rad/s]
    sideslip: FloatArray  # [rad]
    vx_std: FloatArray
    vy_std: FloatArray
    yaw_rate_std: FloatArray
    sideslip_std: FloatArray
    mu: FloatArray  # median [1]
    mu_lower: FloatArray  # 5 %
    mu_upper: FloatArray  # 95 %
    mu_utilised: FloatArray  # largest grip used by any wheel in the last second [1]
    innovation_nis: FloatArray  # per row of measurement; 1 is expected
    adaptation: FloatArray  # largest factor on R
    innovation_log_likelihood: FloatArray  # of the block that ended at the sample, else 0 [nat]
    health: FlagArray  # schemas.signals.Health
    mu_wheel: FloatArray | None  # (T, N, 4, 3) median, lower, upper per wheel, where the estimator has them
    evidence: FloatArray | None  # (T, N, 32) at closes, else NaN: log-likelihood of the visit on the friction grid


@released
def advance_some(
    memory: Memory,
    design: Design,
    scratch: Scratch,
    rows: FloatArray,
    centres: FloatArray,
    t: FloatArray,
    signals: FloatArray,
    closes: BoolArray,
    out: FloatArray,
    health: FlagArray,
    evidence: FloatArray,
    wheels: FloatArray,
    first: int,
    last: int,
) -> None:
    """Fill out (15, T, N), health (T, N), wheels (T, N, 4, 3), and evidence (T, N, 32) where closes (T, N).

    Of the vehicles [first, last) alone.
    """
    for n in range(first, last):
        for k in range(t.shape[0]):
            if closes.shape[0] > 0 and closes[k, n]:
                close_visit(memory, design, scratch, n, centres, evidence[k, n])
            memory.held[n, H.LOG_LIKELIHOOD] = 0.0
            flags = step(memory, design, scratch, rows[n], n, t[k, n], signals[k, n])
            report(memory, design, n, out[:, k, n])
            tell_wheels(memory, design, n, wheels[k, n])
            health[k, n] = flags | int(memory.held[n, H.HEALTH])


@compiled
def close_visit(
    memory: Memory, design: Design, scratch: Scratch, n: int, centres: FloatArray, evidence: FloatArray
) -> None:
    """Write what the visit that ends told (32,), and begin the next from the prior."""
    if not memory.started[n]:
        clear(evidence)
        return
    chain = design.mu.shape[0]
    if memory.held[n, H.UNLIKE] > 0.0:
        told, expected = scratch.predicted[:chain], scratch.plain[:chain]
        projected(memory.visit[n], design.sides.share[2], told)
        projected(design.sides.prior, design.sides.share[2], expected)
        evidence_of(design.mu, expected, told, centres, evidence)
        put(memory.visit[n], design.sides.prior)
    else:
        evidence_of(design.mu, design.prior, memory.visit[n, :chain], centres, evidence)
        put(memory.visit[n, :chain], design.prior)


@compiled
def tell_wheels(memory: Memory, design: Design, n: int, out: FloatArray) -> None:
    """Median, lower and upper friction of the four wheels, (4, 3)."""
    held = memory.held[n]
    for wheel in range(4):
        place = H.LEFT if wheel % 2 == 0 else H.RIGHT
        for k, level in enumerate((0.5, 0.05, 0.95)):
            out[wheel, k] = (
                held[place + k] if memory.started[n] else quantile(design.mu, design.prior, design.prior, level)
            )


@compiled
def report(memory: Memory, design: Design, n: int, out: FloatArray) -> None:
    """Write the outputs (15,) of vehicle n in the order of OUTPUTS."""
    if not memory.started[n]:
        unknown(out, design)
        return
    held = memory.held[n]
    vx, vy = velocity(memory, n)
    std_x = memory.all_covariance[n, X.VX, X.VX] + (design.constants[C.RADIUS_STD] * vx) ** 2
    std_y = memory.all_covariance[n, X.VY, X.VY]
    speed = max(abs(vx), SLOWEST_M_S)
    out[0], out[1], out[2], out[3] = vx, vy, held[H.YAW_RATE], math.atan2(vy, speed)
    out[4], out[5] = math.sqrt(std_x), math.sqrt(std_y)
    out[6] = math.sqrt(held[H.YAW_RATE_VAR] + YAW_RATE_OFFSET_STD**2)
    out[7] = math.sqrt(std_y + (vy / speed) ** 2 * std_x) / speed
    out[8], out[9], out[10] = held[H.MU], held[H.MU_LOWER], held[H.MU_UPPER]
    out[11], out[12] = held[H.USED], held[H.NIS]
    out[13] = max(memory.factor[n, 0], memory.factor[n, 1])
    out[14] = held[H.LOG_LIKELIHOOD]


@compiled
def unknown(out: FloatArray, design: Design) -> None:
    """Outputs (15,) before the first usable sample: the prior, and no motion with a wide spread."""
    clear(out)
    out[4] = UNKNOWN_VX_STD
    out[5] = out[6] = out[7] = 1.0
    out[8] = quantile(design.mu, design.prior, design.prior, 0.5)
    out[9] = quantile(design.mu, design.prior, design.prior, 0.05)
    out[10] = quantile(design.mu, design.prior, design.prior, 0.95)
    out[13] = 1.0


class EstimatorBank:
    """N estimators of one kind; made by `create`."""

    def __init__(self, rows: FloatArray, design: Design) -> None:
        self._rows, self._design = rows, design
        self._memory = new_memory(len(rows))
        self._scratch: list[Scratch] = []

    def advance(
        self, t: FloatArray, signals: FloatArray, closes: BoolArray | None = None, *, threads: int = 1
    ) -> Estimates:
        """Take the next samples of all vehicles.

        Args:
            t: (T, N) measurement time [s]; a sample whose time does not increase is left out, and health says so.
            signals: (T, N, 18) in the order of schemas.signals.CHANNELS; NaN is a missing reading.
            closes: (T, N), True at the first sample that belongs to a new visit; None for no visits.
            threads: how many share the vehicles among them; changes no bit of the result.

        Returns:
            Estimates at the same samples; none of them is NaN, except evidence away from closes.

        Raises:
            InputError: shapes do not agree with the bank, or threads is below 1.
        """
        count = len(self._rows)
        t, signals = checked(t, signals, closes, count)
        ends = np.zeros((0, count), np.bool_) if closes is None else np.ascontiguousarray(closes, np.bool_)
        out = np.empty((len(OUTPUTS), *t.shape))
        health = np.empty(t.shape, np.int32)
        wheels = np.empty((*t.shape, 4, 3))
        evidence = np.full((*ends.shape, BINS), np.nan)
        self._scratch += [new_scratch() for _ in range(threads - len(self._scratch))]
        whole = (self._rows, CENTRES, t, signals, ends, out, health, evidence, wheels)

        def work(share: int, first: int, last: int) -> None:
            advance_some(self._memory, self._design, self._scratch[share], *whole, first, last)

        in_shares(work, count, threads)
        return Estimates._make((*out, health, wheels, None if closes is None else evidence))


def new_scratch() -> Scratch:
    """Room for the intermediate results of one block of one vehicle."""
    count = NODES + PAIRS
    return Scratch(
        features=np.zeros(int(F.LENGTH)),
        loads=np.zeros(4),
        spin=np.zeros(4),
        innovation=np.zeros((count, ROWS)),
        theoretical=np.zeros((count, ROWS)),
        process=np.zeros(STATES),
        keep=np.zeros(STATES),
        gain=np.zeros(8),
        log_likelihood=np.zeros(count),
        plain=np.zeros(count),
        moved=np.zeros(count),
        predicted=np.zeros(count),
        sums=np.zeros(4),
        scales=np.zeros(2),
        root=np.zeros((count, STATES, STATES)),
        room=new_room(),
    )
