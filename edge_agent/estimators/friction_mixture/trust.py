"""How far the model is believed: by how strained it is, and whether any friction explains what is measured.

**Strain** is the chi-square of what is believed of vehicle and sensors against its prior, over the degrees of freedom
that have been learned (Birge 1932). Errors share their cause: where offsets, radii, lags and steering are found to be
small, the axles' other errors are small as well, and where much had to be believed, they are not. So strain scales R
of the axles, and divides the evidence on friction.

**Contradiction** is a test of two hypotheses in sequence (after Page 1954): that the model holds, and that the axles'
innovations have FACTOR times the variance that it states: late steering, a race track's bank. Ice that explains the
data is no sign of it, nor is a far belief alone. Likelihood ratios add up to `odd` [nat] where they speak against the
model, and fade within minutes; a straight, on which it could not fail, does not speak for it. At `odd_least` nothing is
concluded any more: the interval goes back to the prior, the axles have no say in the motion, and what was learned
meanwhile is forgotten. Then the data test nothing, and the model is tried again after `patience` [s], four times as
long with each relapse: sensors stay as they are. Motion that had to be called back by the wheels is half a
contradiction by itself.
"""

from __future__ import annotations

import math

from edge_agent.adaptation.rule_base import hurry
from edge_agent.estimators import flags
from edge_agent.estimators.friction_mixture.constants import Constants, NodeState
from edge_agent.estimators.friction_mixture.design import MixtureDesign, Nominal
from edge_agent.estimators.friction_mixture.memory import MixtureMemory, Trust
from edge_agent.estimators.friction_mixture.node_filter import belief_cost
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled

LEAST_VARIANCE = 1e-12  # before the first innovation
FACTOR = 9.0  # contradiction: errors are three times what they can be
LARGEST_RATIO = 4.0  # [nat/s] a burst of half a second contradicts nothing
CALLED_BACK = 0.5  # of odd_least: once may be a pothole
LONGEST_PATIENCE = 600.0  # [s]
RELAPSE = 4.0  # times as long as the last time
FORGIVEN_S = 300.0  # in which that is forgotten
STRAIGHT = 0.6  # [m/s^2] a_y up to which it is tried again: there the wheels tell the motion
SUSPECTED = 0.8  # of odd_least, where it is tried again: a relapse is found out within a second


@compiled
def judge(memory: MixtureMemory, design: MixtureDesign, duration: float, health: int) -> None:
    """Renew memory.trust by the beliefs, the innovations and the health of the block."""
    if not design.adaptive:
        return
    trust, constants = memory.trust, design.constants
    # by what any car may be: a calibration makes the belief of this one narrower, and contradicts nothing
    cost = belief_cost(memory.overall_mean, design.nominal)
    trust.strain = strain(cost, degrees_of_freedom(memory.overall_covariance, design.nominal), constants.strain_prior)
    trust.hurry = hurry(design.rules, memory.actual[0] / max(memory.theoretical[0], LEAST_VARIANCE) - 1.0)
    if trust.distrust > 0.0:
        trust.left -= duration
        if trust.left <= 0.0 and abs(memory.last.ay) < STRAIGHT:
            trust.distrust, trust.odd = 0.0, SUSPECTED * constants.odd_least
            memory.actual[1] = memory.theoretical[1] = memory.stated = 0.0
            memory.factor[1] = 1.0
        return
    keep = math.exp(-duration / FORGIVEN_S)
    pace = axles_ratio(memory.actual[1], memory.stated) / constants.window
    trust.odd = keep * trust.odd + duration * min(max(pace, 0.0), LARGEST_RATIO)
    trust.patience *= keep
    if health & flags.RESET:
        trust.odd += CALLED_BACK * constants.odd_least
    if trust.odd >= constants.odd_least:
        trust.patience = min(max(RELAPSE * trust.patience, constants.patience), LONGEST_PATIENCE)
        trust.left, trust.distrust, trust.odd = trust.patience, 1.0, constants.odd_least


@compiled
def strain(cost: float, learned: float, prior: float) -> float:
    """Chi-square over degrees of freedom of a belief of `cost` [nat]; 1 where nothing was learned."""
    return (2.0 * cost + prior) / (learned + prior)


@compiled
def degrees_of_freedom(covariance: FloatArray, nominal: Nominal) -> float:
    """How many states of vehicle and sensors have been learned: the share of their prior variance (n,) that is gone."""
    total = 0.0
    for i in range(NodeState.LN_KX, covariance.shape[0]):
        total += max(1.0 - covariance[i, i] / nominal.std[i] ** 2, 0.0)
    return total


@compiled
def strained_noise(trust: Trust, constants: Constants) -> float:
    """Factor on R of the axles by strain."""
    factor = (trust.strain / constants.strain_usual) ** constants.strain_power
    return float(min(max(factor, constants.strain_least), constants.strain_most))


@compiled
def strained_evidence(trust: Trust) -> float:
    """Factor on the evidence on friction by strain; twice as much of a level car's read ice on a dry slalom."""
    return 1.0 / max(trust.strain, 1.0)


@compiled
def likeness(trust: Trust, constants: Constants) -> float:
    """How much the car is as its file says, 0 to 1: 0 from the usual strain on."""
    return max(1.0 - trust.strain / constants.strain_usual, 0.0)


@compiled
def credence(trust: Trust, constants: Constants) -> float:
    """Share of the evidence that is believed: less while a contradiction grows, none once it is believed."""
    return max(1.0 - (trust.odd / constants.odd_least) ** 2, 0.0)


@compiled
def axles_ratio(actual: float, stated: float) -> float:
    """Log-likelihood ratio of the innovation variance of both axles; an R that was adapted has explained nothing."""
    return (1.0 - 1.0 / FACTOR) * actual / max(stated, LEAST_VARIANCE) - math.log(FACTOR)
