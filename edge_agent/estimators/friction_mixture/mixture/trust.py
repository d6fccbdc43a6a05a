"""Trust in the model: its strain (deviation of states from the prior), and a test for
contradictions between model and measurements.

**Strain** is the chi-square of the estimated vehicle and sensor states against their prior, divided
by the degrees of freedom that have been learned (Birge 1932). Errors have common causes. If a car
has small offsets, lags, radius errors and steering errors, the other errors of its axles are small
too. If these errors are large, the others are large. Therefore strain scales the measurement noise
R of the axles. It is also an input of the rules that decide how much of the evidence on friction is
used.

**Contradiction** is a sequential test of two hypotheses (after Page 1954): that the model holds, or
that the axles' innovations have FACTOR times the stated variance. The second case occurs, for
example, with delayed steering signals or on the banking of a race track. Data that ice explains do
not count against the model, and neither do unusual vehicle states alone. The sum of the
log-likelihood ratios against the model is `odd` [nat]; old terms fade within minutes. Straight
driving does not count in favour of the model, because the model cannot fail there. Once `odd`
reaches the threshold `odd_least`, the filter draws no conclusions. The friction interval and the
vehicle states then return to their prior, and the axles do not affect the motion. The test leaves
out slides, slippery road and walking pace (`unexplained_share`).

While the filter draws no conclusions, the model cannot be tested. Therefore the filter uses the
model again after `patience` [s]. Each further contradiction makes this time four times as long,
because sensors do not repair themselves. A reset of the motion to the wheel speeds counts as half a
contradiction, where no slide, slippery road or walking pace explains it. For example, many wheel
sensors give no signal below 1 m/s, so that a car that starts seems to jump.
"""

from __future__ import annotations

import math

from edge_agent.estimators import flags
from edge_agent.estimators.friction_mixture.state.constants import (
    ALL_NODES,
    NODES,
    Constants,
    NodeState,
)
from edge_agent.estimators.friction_mixture.state.design import MixtureDesign, Nominal
from edge_agent.estimators.friction_mixture.state.gap import SLOW_M_S
from edge_agent.estimators.friction_mixture.state.memory import MixtureMemory, Trust
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled
from schemas.thresholds import CALLED_SHARE, SLIPPERY_MU

# [1] innovation variance over the stated one under a contradiction: errors are three times as large
FACTOR = 9.0
# [nat/s] largest growth rate of the evidence against the model, so that a burst of large errors of
# half a second does not suffice
LARGEST_RATIO = 4.0
# [1] share of `odd_least` that a reset of the motion adds. One reset alone may come from a pothole.
CALLED_BACK = 0.5
LONGEST_PATIENCE = 600.0  # [s] longest time before the model is tried again
RELAPSE = 4.0  # [1] factor on the time before the next trial after each further contradiction
FORGIVEN_S = 300.0  # [s] time constant with which evidence against the model and patience fade


@compiled
def update_consistency(
    memory: MixtureMemory, design: MixtureDesign, duration: float, ratio: float, health: int
) -> None:
    """Update memory.trust, the filter's trust in its model, after a block (0.05 s) of `duration`
    [s].

    The strain (deviation of the vehicle and sensor states from their prior) is computed from the
    current states. The log-likelihood ratio against the model grows with the innovations
    (measurement minus prediction) and with a reset of the motion (`health`). At its threshold, the
    filter stops using evidence on friction for some time.

    `ratio` is the sum of the squared innovations of the axles in the block over their stated
    variance.
    """
    if not design.adaptive:
        return
    trust = memory.trust
    constants = design.constants
    # Compare with the prior of any car. The narrower prior of a calibrated car would turn small
    # deviations into strain.
    cost = mixture_cost(memory.overall_mean, design.nominal)
    trust.strain = belief_strain(
        cost,
        degrees_of_freedom(memory.overall_covariance, design.nominal),
        constants.chosen.strain_prior,
    )
    if trust.distrust > 0.0:
        _await_next_trial(memory, duration)
        return
    keep = math.exp(-duration / FORGIVEN_S)
    fading = math.exp(-duration / constants.chosen.window)
    share = unexplained_share(memory, design)
    trust.ratio = fading * trust.ratio + (1.0 - fading) * share * ratio
    # A slide explains the errors before it too: the front axle reaches ice before a wheel slides.
    pace = axles_ratio((1.0 - memory.slip.held) * trust.ratio) / constants.chosen.window
    trust.odd = keep * trust.odd + duration * min(max(pace, 0.0), LARGEST_RATIO)
    trust.patience *= keep
    if health & flags.RESET:
        trust.odd += share * CALLED_BACK * constants.chosen.odd_least
    if trust.odd >= constants.chosen.odd_least:
        patience = max(RELAPSE * trust.patience, constants.chosen.patience)
        trust.patience = min(patience, LONGEST_PATIENCE)
        trust.left = trust.patience
        trust.distrust = 1.0
        trust.odd = constants.chosen.odd_least


@compiled
def _await_next_trial(memory: MixtureMemory, duration: float) -> None:
    """Count down the time during which the filter does not use evidence on friction, by a block of
    `duration` [s]. At its end, trust the model again, without the evidence of before.
    """
    trust = memory.trust
    trust.left -= duration
    if trust.left > 0.0:
        return
    trust.distrust = 0.0
    trust.odd = 0.0
    trust.ratio = 0.0
    memory.actual = 0.0
    memory.theoretical = 0.0
    memory.factor = 1.0


@compiled
def unexplained_share(memory: MixtureMemory, design: MixtureDesign) -> float:
    """Return the share of the axles' squared innovations that counts as a contradiction of the
    model, because neither a slide nor slippery road explains it.

    While a wheel slides, or the road is estimated to be slippery, the axles' forces differ from the
    model for a while. Wrong signals also look like a slippery road, so the belief in it explains at
    most CALLED_SHARE. Tight turns at walking pace are outside the model's range and do not count
    either.
    """
    speed = abs(memory.overall_mean[NodeState.VX])
    moving = min(max(speed / SLOW_M_S - 1.0, 0.0), 1.0)
    explained = CALLED_SHARE * slippery_probability(memory, design)
    return float(moving * (1.0 - memory.slip.held) * (1.0 - explained))


@compiled
def slippery_probability(memory: MixtureMemory, design: MixtureDesign) -> float:
    """Return the probability that the friction, averaged over the left and right side of the car,
    lies below SLIPPERY_MU.
    """
    total = 0.0
    for j in range(ALL_NODES if memory.split else NODES):
        if 0.5 * (design.sides.mu[j, 0] + design.sides.mu[j, 1]) < SLIPPERY_MU:
            total += memory.weight[j]
    return total


@compiled
def mixture_cost(mean: FloatArray, nominal: Nominal) -> float:
    """Return half the chi-square of the mixture's vehicle and sensor states against their prior
    [nat]: half the sum of squared deviations in standard deviations. `mean` (n,) are the states.
    """
    total = 0.0
    for i in range(NodeState.LN_KX, mean.shape[0]):
        total += 0.5 * ((mean[i] - nominal.mean[i]) / nominal.std[i]) ** 2
    return total


@compiled
def belief_strain(cost: float, learned: float, prior: float) -> float:
    """Return the strain: how far the estimated vehicle and sensor states deviate from their prior,
    as chi-square per degree of freedom. `cost` [nat] is half of that chi-square.

    `learned` is the number of degrees of freedom that measurements have determined. The chi-square
    of a few degrees of freedom is uncertain. Therefore `prior` degrees of freedom with a chi-square
    of 1 each are added. Without learned states the result is thus 1.
    """
    return (2.0 * cost + prior) / (learned + prior)


@compiled
def degrees_of_freedom(covariance: FloatArray, nominal: Nominal) -> float:
    """Return the effective number of learned vehicle and sensor states.

    Each state counts by the share of its prior variance that the measurements have removed.
    `covariance` (n, n) is the covariance of the current estimate, and `nominal` contains the prior.
    """
    total = 0.0
    for i in range(NodeState.LN_KX, covariance.shape[0]):
        total += max(1.0 - covariance[i, i] / nominal.std[i] ** 2, 0.0)
    return total


@compiled
def nominal_agreement(trust: Trust, constants: Constants) -> float:
    """Return the degree, 0 to 1, to which the car agrees with its vehicle file. It is 1 without
    strain (deviation of the states from their prior), decreases linearly with the strain, and is 0
    from the strain `strain_usual` on.
    """
    return max(1.0 - trust.strain / constants.chosen.strain_usual, 0.0)


@compiled
def used_evidence_share(trust: Trust, constants: Constants) -> float:
    """Return the share of the evidence on friction that the filter uses. It decreases as evidence
    against the model grows, and is 0 once the consistency test declares a contradiction.
    """
    return max(1.0 - (trust.odd / constants.chosen.odd_least) ** 2, 0.0)


@compiled
def axles_ratio(ratio: float) -> float:
    """Return the log-likelihood ratio [nat] of two hypotheses about the variance of the axles'
    innovations: FACTOR times the stated variance, or the stated variance. `ratio` is the sum of the
    squared innovations over the stated variance.
    """
    return (1.0 - 1.0 / FACTOR) * ratio - math.log(FACTOR)
