"""Tables of the default estimator for the compiled functions. They are computed once from its
constants and do not change while driving.
"""

from __future__ import annotations

from functools import cache, partial
from typing import Annotated, NamedTuple

import numpy as np

from edge_agent.adaptation.memberships import Memberships
from edge_agent.adaptation.rule_base import RuleBase, plain_rules, rule_base
from edge_agent.estimators.friction_mixture.state.constants import (
    NODES,
    STATES,
    Constants,
    NodeState,
)
from edge_agent.estimators.friction_mixture.state.friction_grid import (
    friction_prior,
    node_table,
)
from edge_agent.estimators.friction_mixture.state.split_sides import Sides, side_table
from edge_agent.estimators.friction_mixture.state.tyre_curve import (
    Curve,
    TyreCurve,
    curve_tables,
    magic_formulas,
)
from schemas.numeric import FloatArray


class Nominal(NamedTuple):
    """Prior of the filter states that describe the vehicle, its sensors or the road: mean, standard
    deviation, and time of return to the prior. The velocity states have no prior.
    """

    mean: Annotated[FloatArray, STATES]
    std: Annotated[FloatArray, STATES]
    time: Annotated[FloatArray, STATES]  # [s] time in which a state returns to its prior


class MixtureDesign(NamedTuple):
    """All constant tables that a variant of the friction mixture (grid of friction hypotheses)
    reads.
    """

    constants: Constants
    mu: Annotated[FloatArray, NODES]  # friction of the nodes with one friction for both sides
    width: Annotated[FloatArray, NODES]  # share of the friction range that a node represents
    prior: Annotated[FloatArray, NODES]
    sides: Sides  # friction and prior of all nodes
    curve: TyreCurve
    nominal: Nominal
    fuzzy_inputs: Annotated[FloatArray, 5]  # peaks of the fuzzy sets that adapt R
    fuzzy_outputs: Annotated[FloatArray, 5]  # [nat] change of ln R for each set
    rules: RuleBase
    scales: Annotated[FloatArray, 2]  # factors on the nominal R of wheels and axles
    adaptive: bool  # True if the fuzzy rules are applied


def nominal_states(constants: Constants) -> Nominal:
    """Return the prior of the states of a node (filter of one friction hypothesis): mean, standard
    deviation, and time within which a state returns to the prior.
    """
    mean = np.zeros(STATES)
    std = np.ones(STATES)
    time = np.full(STATES, np.inf)
    p = constants.physical
    x = NodeState
    for state, spread in (
        (x.LN_KX, p.stiffness_std),
        (x.LN_KY, p.stiffness_std),
        (x.LEAK_Y, p.leak),
        (x.STEER, p.steer_std),
        (x.SHAPE, p.shape_std),
        (x.GAIN, p.force_share),
        (x.BIAS_X, p.offset_std),
        (x.BIAS_Y, p.offset_std),
        *((x.RADIUS + wheel, p.wheel_std) for wheel in range(4)),
        (x.LAG_WHEEL, p.lag_std),
        (x.LAG_STEER, p.lag_std),
        (x.COMPLIANCE, p.compliance_std),
        (x.STEER_GAIN, p.steer_gain_std),
        (x.SLOPE, p.offset_std),
        (x.BANK, p.offset_std),
    ):
        std[state] = spread
        time[state] = p.return_time
    mean[x.LEAK_Y] = p.leak
    mean[x.COMPLIANCE] = p.compliance_mean
    return Nominal(mean, std, time)


def design_of(
    memberships: Memberships,
    *,
    adaptive: bool,
    constants: Constants | None = None,
    curve: Curve | None = None,
) -> MixtureDesign:
    """Return the tables of a friction mixture for the given fuzzy sets. Studies pass other
    `constants`; other tyres need another `curve`.
    """
    constants = constants or Constants()
    nodes = _node_tables(constants.physical.common_mu, constants.physical.split_prior)
    return MixtureDesign(
        constants=constants,
        mu=nodes.mu,
        width=nodes.width,
        prior=nodes.prior,
        sides=nodes.sides,
        curve=curve_tables(curve) if curve else _usual_curve(constants.physical.curve_c),
        nominal=nominal_states(constants),
        fuzzy_inputs=np.array(memberships.inputs),
        fuzzy_outputs=np.array(memberships.outputs),
        rules=rule_base(memberships) if adaptive else plain_rules(constants.chosen.steady_share),
        scales=np.exp(np.array(memberships.ln_scales)),
        adaptive=adaptive,
    )


class NodeTables(NamedTuple):
    """Tables of the nodes; see `MixtureDesign`."""

    mu: FloatArray
    width: FloatArray
    prior: FloatArray
    sides: Sides


@cache
def _node_tables(common_mu: float, split_prior: float) -> NodeTables:
    """Return the tables of the nodes. They are kept, because computing them takes as long as
    estimating several seconds of a drive.

    Args:
        common_mu: friction up to which all values are equally probable a priori [1].
        split_prior: prior probability of different friction left and right [1].
    """
    mu, width = node_table(NODES)
    prior = friction_prior(mu, width, common_mu)
    return NodeTables(mu, width, prior, side_table(mu, prior, split_prior))


@cache
def _usual_curve(c: float) -> TyreCurve:
    """Return the tables of the Magic Formula with shape factor `c`. They are kept, because
    computing them takes as long as estimating a minute of a drive.
    """
    return curve_tables(partial(magic_formulas, c=c, e=0.0))
