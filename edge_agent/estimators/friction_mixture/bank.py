"""The friction mixture (filter with a grid of friction hypotheses) for many vehicles: the bank of
estimators with its compiled function, and the functions that write its output.
"""

from __future__ import annotations

from edge_agent.estimators.bank import EstimatorBank, Part
from edge_agent.estimators.common.arrays import clear_vector, copy_vector
from edge_agent.estimators.common.output import write_motion, write_quality, write_unknown
from edge_agent.estimators.estimates import FOUR_FRICTIONS, Column
from edge_agent.estimators.friction_mixture.block.grip_guard import reported_upper
from edge_agent.estimators.friction_mixture.report.beliefs import report_beliefs
from edge_agent.estimators.friction_mixture.report.reported_interval import LOWER_END, UPPER_END
from edge_agent.estimators.friction_mixture.report.visit_parts import begin_part, end_part
from edge_agent.estimators.friction_mixture.state.constants import NODES, NodeState
from edge_agent.estimators.friction_mixture.state.design import MixtureDesign
from edge_agent.estimators.friction_mixture.state.friction_grid import quantile, visit_evidence
from edge_agent.estimators.friction_mixture.state.gap import YAW_STD
from edge_agent.estimators.friction_mixture.state.memory import (
    MixtureMemory,
    Quantiles,
    new_filters,
)
from edge_agent.estimators.friction_mixture.state.split_sides import BOTH, project_weights
from edge_agent.estimators.friction_mixture.state.workspace import MixtureContext, Scratch
from edge_agent.estimators.friction_mixture.step import mean_velocity, step
from schemas.mugrid import CENTRES
from schemas.numeric import BoolArray, FloatArray
from schemas.runtime.jit import compiled, nogil
from schemas.runtime.records import Records, put_record, records


def mixture_bank(
    rows: FloatArray,
    design: MixtureDesign,
    spreads: FloatArray | None = None,
    means: FloatArray | None = None,
) -> EstimatorBank:
    """Return a bank of friction mixtures (filters with a grid of friction hypotheses), one per
    vehicle. `rows` (N, 16) are the vehicles' parameters.

    `spreads` and `means` (N, STATES) are standard deviations and means of the priors of the
    filter's states. By default they are the priors in the tables of `design`.
    """
    context = records(MixtureContext, 1)
    put_record(context["design"][0], design)
    return EstimatorBank(
        new_filters(
            rows,
            design.nominal,
            design.nominal.mean if means is None else means,
            design.nominal.std if spreads is None else spreads,
        ),
        context,
        _advance_filters,
        columns=FOUR_FRICTIONS,
        evidence=True,
        beliefs=report_beliefs,
    )


@nogil
def _advance_filters(
    filters: Records[MixtureMemory],
    contexts: Records[MixtureContext],
    t: FloatArray,
    signals: FloatArray,
    results: tuple[FloatArray, BoolArray, FloatArray],
    part: Part,
) -> None:
    (outputs, closes, evidence) = results
    (share, first, last) = part
    context = contexts[share]
    design = context.design
    scratch = context.scratch
    for n in range(first, last):
        memory = filters[n]
        for k in range(t.shape[0]):
            if closes.shape[0] > 0 and closes[k, n]:
                close_visit(memory, design, scratch, evidence[k, n])
            memory.log_likelihood = 0.0
            output = outputs[k, n]
            health = step(memory, design, scratch, t[k, n], signals[k, n])
            # A block without samples means that the last block has just ended.
            if closes.shape[0] > 0 and memory.started and memory.block.samples == 0:
                end_part(memory, design, evidence[k, n])
            write_estimates(memory, design, output)
            output[Column.HEALTH] = health | memory.health


@compiled
def close_visit(
    memory: MixtureMemory, design: MixtureDesign, scratch: Scratch, evidence: FloatArray
) -> None:
    """Write the evidence (32,) of the visit (passage of one map cell) that ends, and start the next
    visit from the prior.

    The evidence on friction is the log-likelihood of the visit's measurements on the friction grid,
    with maximum 0.
    """
    if not memory.started:
        clear_vector(evidence)
    elif memory.split:
        project_weights(memory.visit_weight, design.sides.share[BOTH], scratch.projected)
        project_weights(design.sides.prior, design.sides.share[BOTH], scratch.expected)
        visit_evidence(design.mu, scratch.expected, scratch.projected, CENTRES, evidence)
        copy_vector(memory.visit_weight, design.sides.prior)
    else:
        visit_evidence(design.mu, design.prior, memory.visit_weight[:NODES], CENTRES, evidence)
        copy_vector(memory.visit_weight[:NODES], design.prior)
    begin_part(memory, design)


@compiled
def write_estimates(memory: MixtureMemory, design: MixtureDesign, output: FloatArray) -> None:
    """Write the current estimates of a vehicle's filter (`memory`) into `output`, the estimated
    quantities of one sample. The caller adds the health flags.
    """
    if not memory.started:
        report_prior(design, output)
        return
    last = memory.last
    vx, vy = mean_velocity(memory)
    constants = design.constants
    var_x = memory.overall_covariance[NodeState.VX, NodeState.VX]
    # No sensor measures the common radius error and the common delay.
    var_x += (constants.physical.wheel_std * vx) ** 2 + (
        constants.physical.common_lag * last.ax
    ) ** 2
    var_y = memory.overall_covariance[NodeState.VY, NodeState.VY]
    var_rate = last.yaw_rate_var + YAW_STD**2
    write_motion(output, (vx, vy, last.yaw_rate), (var_x, var_y, var_rate))
    _report_friction(
        memory.friction, reported_upper(memory.grip, memory.friction), output, Column.MU
    )
    output[Column.P_SLIPPERY] = memory.friction.p_slippery
    for wheel in range(4):
        side = memory.friction_left if wheel % 2 == 0 else memory.friction_right
        upper = side.upper if memory.split else reported_upper(memory.grip, side)
        _report_friction(side, upper, output, Column.WHEELS + 3 * wheel)
    write_quality(
        output, memory.excitation.largest, memory.nis, memory.factor, memory.log_likelihood
    )


@compiled
def _report_friction(friction: Quantiles, upper: float, output: FloatArray, first: int) -> None:
    output[first] = friction.median
    output[first + 1] = friction.lower
    output[first + 2] = upper


@compiled
def report_prior(design: MixtureDesign, output: FloatArray) -> None:
    """Write to `output` the estimates before the first usable sample: the friction prior, and zero
    motion with a large standard deviation.
    """
    write_unknown(output)
    for k, level in enumerate((0.5, LOWER_END, UPPER_END)):
        value = quantile(design.mu, design.width, design.prior, level)
        output[Column.MU + k] = value
        for wheel in range(4):
            output[Column.WHEELS + 3 * wheel + k] = value
