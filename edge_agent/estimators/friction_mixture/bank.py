"""The estimator bank: N vehicles side by side through one compiled path.

No vehicle's numbers meet another's, and all state lies in the memory, so results are bit-equal whatever N is and
however the samples are cut into calls.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from edge_agent.estimators.friction_mixture.advance import Design, Scratch, step, velocity
from edge_agent.estimators.friction_mixture.block import F
from edge_agent.estimators.friction_mixture.constants import NODES, STATES, X
from edge_agent.estimators.friction_mixture.memory import H, Memory, new_memory
from edge_agent.estimators.friction_mixture.nodes import evidence as evidence_of
from edge_agent.estimators.friction_mixture.nodes import quantile
from edge_agent.estimators.friction_mixture.residuals import ROWS
from edge_agent.estimators.friction_mixture.sample import UNKNOWN_VX_STD
from schemas.errors import InputError
from schemas.mugrid import BINS, CENTRES
from schemas.numeric import BoolArray, FloatArray, compiled
from schemas.signals import CHANNELS

OUTPUTS = (
    "vx", "vy", "yaw_rate", "sideslip", "vx_std", "vy_std", "yaw_rate_std", "sideslip_std",
    "mu", "mu_lower", "mu_upper", "mu_utilised", "innovation_nis", "adaptation", "innovation_log_likelihood",
)  # fmt: skip
FlagArray: TypeAlias = NDArray[np.int32]

SLOWEST_M_S = 0.5  # sideslip is taken against at least this speed
YAW_RATE_OFFSET_STD = 0.001  # [rad/s]


@dataclass(frozen=True)
class Estimates:
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


@compiled
def advance_all(
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
) -> None:
    """Fill out (15, T, N), health (T, N) and evidence (T, N, 32) where closes (T, N); other evidence stays."""
    for n in range(t.shape[1]):
        for k in range(t.shape[0]):
            if closes.shape[0] > 0 and closes[k, n]:
                if memory.started[n]:
                    evidence_of(design.mu, design.prior, memory.visit[n], centres, evidence[k, n])
                else:
                    evidence[k, n] = 0.0
                memory.visit[n] = design.prior
            memory.held[n, H.LOG_LIKELIHOOD] = 0.0
            flags = step(memory, design, scratch, rows[n], n, t[k, n], signals[k, n])
            report(memory, design, n, out[:, k, n])
            health[k, n] = flags | int(memory.held[n, H.HEALTH])


@compiled
def report(memory: Memory, design: Design, n: int, out: FloatArray) -> None:
    """Write the outputs (15,) of vehicle n in the order of OUTPUTS."""
    if not memory.started[n]:
        unknown(out, design)
        return
    held = memory.held[n]
    vx, vy = velocity(memory, n)
    root = memory.all_root[n]
    std_x = std_y = 0.0
    for j in range(root.shape[0]):
        std_x += root[X.VX, j] ** 2
        std_y += root[X.VY, j] ** 2
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
    out[:] = 0.0
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
        self._scratch = new_scratch()

    def advance(self, t: FloatArray, signals: FloatArray, closes: BoolArray | None = None) -> Estimates:
        """Take the next samples of all vehicles.

        Args:
            t: (T, N) measurement time [s]; a sample whose time does not increase is left out, and health says so.
            signals: (T, N, 18) in the order of schemas.signals.CHANNELS; NaN is a missing reading.
            closes: (T, N), True at the first sample that belongs to a new visit; None for no visits.

        Returns:
            Estimates at the same samples; none of them is NaN, except evidence away from closes.

        Raises:
            InputError: shapes do not agree with the bank.
        """
        count = len(self._rows)
        t, signals = np.ascontiguousarray(t, np.float64), np.ascontiguousarray(signals, np.float64)
        if t.ndim != 2 or t.shape[1] != count:
            raise InputError("t", f"shape {t.shape} for a bank of {count}", "give (T, N)")
        if signals.shape != (*t.shape, len(CHANNELS)):
            raise InputError("signals", f"shape {signals.shape}", f"give {(*t.shape, len(CHANNELS))}")
        if closes is not None and closes.shape != t.shape:
            raise InputError("closes", f"shape {closes.shape}", f"give {t.shape}")
        ends = np.zeros((0, count), np.bool_) if closes is None else np.ascontiguousarray(closes, np.bool_)
        out = np.empty((len(OUTPUTS), *t.shape))
        health = np.empty(t.shape, np.int32)
        evidence = np.full((*ends.shape, BINS), np.nan)
        advance_all(
            self._memory, self._design, self._scratch, self._rows, CENTRES, t, signals, ends, out, health, evidence
        )
        named = dict(zip(OUTPUTS, out, strict=True))
        return Estimates(**named, health=health, mu_wheel=None, evidence=None if closes is None else evidence)


def new_scratch() -> Scratch:
    """Room for the intermediate results of one block of one vehicle."""
    points = 2 * STATES
    return Scratch(
        features=np.zeros(int(F.LENGTH)),
        loads=np.zeros(4),
        spin=np.zeros(4),
        at_force=np.zeros(ROWS),
        slopes=np.ones(4),
        points=np.zeros((points, STATES)),
        outcomes=np.zeros((points, ROWS)),
        innovation=np.zeros((NODES, ROWS)),
        theoretical=np.zeros((NODES, ROWS)),
        noise=np.zeros(ROWS),
        process=np.zeros(STATES),
        gain=np.zeros(8),
        log_likelihood=np.zeros(NODES),
        plain=np.zeros(NODES),
        predicted=np.zeros(NODES),
        sums=np.zeros(4),
        scales=np.zeros(2),
        work=np.zeros((2 * STATES + ROWS, max(NODES * (STATES + 1), points + ROWS, 2 * STATES + 1))),
    )
