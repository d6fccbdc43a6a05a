"""Constants of the fusion (the map's computation from the reports of all vehicles), each with the
reason for its value, in three parts: physical, chosen, and guards. `fleet_service/fusion/README.md`
explains the mathematics.

Terms
    visit          one passage of a vehicle through a cell
    value, bound   report that measures the friction; report that μ is at least the grip used
    vote           effect of one visit on the belief about a cell
    tuning town    simulated town (`lab/town.py`) whose seed serves only to choose constants
    tuning drive   end-to-end drive with the real estimator (`lab/end_to_end.py`), whose
                   seed also serves only to choose constants
"""

from __future__ import annotations

from typing import Final

from schemas import mugrid, thresholds
from schemas.thresholds import NS, SURFACES, VALUE_NATS

BIN_WIDTH: Final = (mugrid.UPPER - mugrid.LOWER) / mugrid.BINS  # [μ] width of a friction bin

# ====== Physical: roads, vehicles, and the errors of their reports ======

# --- Error of one vehicle ---

# Share of values that contain no information about the road: faulty sensor, wrong cell, wrong tyre
# model. At the border of a surface, 12 % of the position fixes alone are in the wrong cell. Because
# of this share, one vote changes the ratio of two probabilities by a factor of at most about 60.
CONTAMINATION: Final = 0.15
# Standard deviation of a vehicle's constant error, relative to μ. Tyres, mass and stiffness that
# are wrong by a few per cent shift all its values in the same direction. The vehicle's own visits
# do not average this error out, so each vote is widened by it. The error is not learned per
# vehicle: in three tuning towns per fleet and three tuning drives, learning it changed interval
# scores by 3 % (7 % if half of the fleet had a bias).
BIAS_RELATIVE: Final = 0.05
# [μ] Additive part of the same error. A vehicle has .015; rounding to bins adds the rest.
BIAS_ABSOLUTE: Final = 0.01

# --- Error that all vehicles in a place share (same manoeuvre, tyre model, ruts) ---
# More vehicles do not average this error out; see `shared`.

# [μ] Standard deviation of the part that does not grow with the grip, for readings that are too
# low. It stands for crossfall (2.5 % on roads), slopes that no filter knows, and drag mistaken for
# a tyre force. In cells on ice (μ ≤ .2) of five tuning drives, the intervals contained the true μ
# in .80 of the cases with .01 and in .86 with .02.
COMMON_ABSOLUTE: Final = 0.02
# [μ] The same for readings that are too high. It is larger, because one in seven visits to ice
# reports the grip of the road next to the ice, in the same cell or the one before. In towns with
# the errors of four tuning drives, intervals contained the true μ in .78 of the icy cells with .02
# and in .81 with .025; on other surfaces not less often.
COMMON_HIGH: Final = 0.025
# Relative standard deviation of the part that all kinds of manoeuvre share, in cells with values.
COMMON_ALWAYS: Final = 0.02
# Relative standard deviation in cells where vehicles reported only bounds.
COMMON_RELATIVE: Final = 0.04
# Relative standard deviation of the part that only vehicles with the same kind of manoeuvre share.
COMMON_MANOEUVRE: Final = 0.05
# The tyre-curve error is a slope times the unused share of grip. `trust.shape_of` learns the slope
# from differences between visits of the same vehicle. This amount is added to the learned slope,
# because other tyres and surfaces may have other curves.
SHAPE_DOUBT: Final = 0.1
# Prior mean of the slope, and its standard deviation. The prior weighs as much as about 20
# comparisons.
SHAPE_PRIOR: Final = 0.15
# Share of a vehicle's stated variance that is an error common to all vehicles that do the same
# manoeuvre in a place. On three rough tuning drives, errors in one place had a correlation of .6
# for the same kind of manoeuvre. With .1, .08 and .05, alerts of ten tuning drives found .562, .587
# and .622 of the slippery cells, and 28, 32 and 41 of 600 tuning fleets on winter tyres raised a
# false alert in a wet curve.
SHARED_PART: Final = 0.08

# --- Evidence from slippery neighbouring cells, see `neighbours` ---

# P(the next cell has the same surface). In three tuning drives the Brier score of P(slippery) was
# .0526 with .8 and .0471 with .9.
SAME_SURFACE: Final = 0.9

# --- Change of a road with time ---

# Standard deviation of μ after one hour of slow change (drying, polishing), a random walk.
DRIFT_PER_ROOT_HOUR: Final = 0.04
# [s] Mean time between sudden changes of a road; the vehicles' copy of the map fades with it too.
CHANGE_S: Final = thresholds.CHANGE_S

# --- From a report to a likelihood ---

# Standard deviation of the grip used: accelerometer and load transfer, about 5 % of g.
UTILISED_STD: Final = 0.05
# Relative part of the same error, as large as a value's: mass over the wheels, roll, sensor gain.
UTILISED_RELATIVE: Final = BIAS_RELATIVE
# [μ] Smallest standard deviation of a value that is believed when two values are compared. A value
# is computed from the grip used, so it is not more accurate.
NOVELTY_STD: Final = UTILISED_STD
# Share of bounds that belong to another road or are no bounds. On two rough tuning drives, 2 to 6 %
# of the bounds were too high by more than .1, and all were where the surface changes inside a cell.
# With .3, .15, .1 and .05, the error after six minutes of ten tuning drives was .0861, .0805, .0790
# and .0778, and .0402, .0408, .0414 and .0420 of the slippery cells had P(slippery) < .3.
BOUND_CONTAMINATION: Final = 0.1
# [μ] Standard deviation of a posterior sent without an interval: half of the range of wet roads, as
# if only the kind of road were known.
POSTERIOR_STD: Final = 0.5 * (SURFACES["wet"][1] - SURFACES["wet"][0])

# --- Trust: comparison of values of different vehicles in the same cell ---

# [μ] Two values are not compared if their difference has a larger standard deviation, because then
# they would agree with everything.
PEER_STD: Final = 0.25

# ====== Chosen: weights and thresholds of the method ======

# --- Error that all vehicles in a place share (same manoeuvre, tyre model, ruts) ---

# If a vehicle uses less than this share of a road's grip, its value may be too low, because it
# depends on the assumed tyre curve. This error widens intervals upwards and corrects no value.
SHARED_SHARE: Final = 0.8
# A comparison weighs as much as its squared difference in grip used, divided by its variance. When
# a vehicle's weights exceed this sum, all its comparisons so far count half. The sum is almost
# seven times the weight of the prior.
SHAPE_MEMORY: Final = 300.0
# Relative shared error σ_s at which a value has half the weight of a value without such an error.
SHARED_WIDE: Final = 0.1

# --- Evidence from slippery neighbouring cells, see `neighbours` ---

# Number of cells before, and number of cells behind, that may send a message to a cell.
NEIGHBOURS: Final = 4
# Number of measured cells before, and number of measured cells behind, that a measured cell hears.
# With 0, 1, 2 and 4, known road-hours in three tuning towns with 20 cars an hour were .416, .509,
# .535 and .528, the error in six tuning drives was .0955, .0900, .0895 and .0910, and coverage on
# winter tyres was .846, .812, .800 and .786.
HEARD_CELLS: Final = 2
# A neighbour with a smaller P(slippery) ends the slippery stretch: cells beyond it send no message.
NEIGHBOUR_GRIP: Final = 0.1

# --- Repeated reports of one vehicle in one cell ---

# [s] Time constant with which a vehicle's vote counts again, at the rate at which the map forgets
# the first vote by slow and sudden change. So no vehicle controls a cell by passing it all day. The
# vote counts again by 95 % (1 - e⁻³) in the mean time between changes.
VOTE_RENEWAL_S: Final = CHANGE_S / 3.0
# Two values at least this many standard deviations apart come from two different roads, or one is
# wrong. A value so far from the vehicle's own last value in the cell counts in full at once,
# because the vehicle's bias cancels in the difference. Up to PEERS_AGREE the difference is noise.
PEERS_DISAGREE: Final = 4.0
# Number of whole votes that a vehicle has in a cell per VOTE_RENEWAL_S, however often its values
# change: one vote and one change. With 1.5, ice is found after four passes instead of three.
VOTES: Final = 2.0
# [s] Shortest time between two visits that count as separate, because driving round a block takes
# longer. So a flood of reports counts as one report.
REVISIT_S: Final = 20.0
# [s] Time for which a vehicle's values in a cell are remembered. By then 95 % of its vote counts
# again. Bounds are remembered for VOTE_RENEWAL_S only, when 63 % counts again. Most visits give
# bounds, so the memory holds the visits of one hour and the values of three.
FORGOTTEN_S: Final = CHANGE_S

# --- Visits without a value ---

# A visit without a value is evidence against slippery road if other visits to the cell gave values.
# The evidence is the share of the cell's visits, this one included, that gave a value, times this
# factor. The factor is below 1 because a warned driver uses less grip. In four tuning towns with 20
# vehicles an hour, the share of correct alerts was .883 without this evidence and .914 with it. The
# share of ice that alerts found was .906 in both cases.
SILENCE: Final = 0.4
# Visits without a value lower P(slippery) at most to this: no longer probable, but not improbable.
# Also P(slippery) of a bound that does not show grip.
UNSURE: Final = 0.45

# --- From a report to a likelihood ---

# [nat] Smallest difference of log-likelihoods that counts as evidence, the same as for a value.
# A likelihood that falls by less than this towards the highest μ is taken as flat there, so it is a
# bound. The contract allows senders half a nat of slope above the grip used; this is twice that.
# A source of ice must give this evidence for ice against grip, after allowing for the error of the
# assumed tyre curve. In two tuning drives, 1.5 nats were reached by 20 % of visits to ice (μ <
# .25), .6 % to wet road and .08 % to dry road; 3 nats by 12 %, .2 % and .04 %. With two nats
# instead of one, alerts in three drives found .13 of the snow instead of .17, and as much ice
# (.80).
EVIDENCE_NATS: Final = VALUE_NATS
VALUE_DROP_STEPS: Final = int(EVIDENCE_NATS * mugrid.STEPS_PER_NAT)  # the same in encoded steps
# Largest fall of a bound's log-likelihood towards the highest friction that is noise, in steps.
NOISE_DROP_STEPS: Final = VALUE_DROP_STEPS // 2

# --- Trust: comparison of values of different vehicles in the same cell ---

# Two values agree fully up to this many standard deviations of their difference (bias included),
# and not at all from PEERS_DISAGREE on. Honest vehicles then agree in 95 % of their comparisons on
# every kind of road; wrong cells and changing roads cause the rest.
PEERS_AGREE: Final = 2.5
PEER_S: Final = 900  # [s] values further apart in time are not compared: both may be right
# Number of comparisons with one other vehicle above which the earlier ones count half. A vehicle
# that begins to lie, or whose sensor was repaired, is noticed within minutes. Noise stays small
# because trust is a mean over many other vehicles.
PEER_MEMORY: Final = 3.0
REPORTERS: Final = 6  # number of latest values per cell with which a new value is compared
# Number of other vehicles that a vehicle's comparison record holds: a sample of all it met, large
# enough for a mean.
PEERS: Final = 48
# Trust begins as if the vehicle had been compared with TRUST_PRIOR_PEERS others and had agreed
# with the share of values that contain information about the road, 1 - CONTAMINATION.
TRUST_PRIOR_PEERS: Final = 8.0
# Share of agreement at or below which a vehicle has no weight: it disagrees with 30 % of the
# trusted vehicles, twice the assumed share. If less than a third of a fleet colludes, only the
# colluders fall below it.
TRUST_NONE: Final = 1.0 - 2.0 * CONTAMINATION
TRUST_FULL: Final = 0.9  # share of agreement from which trust is 1
# A vehicle is known once it has been compared with this many others, weighted by their trust.
ESTABLISHED_PEERS: Final = 4.0
# Number of known and trusted vehicles from which every vehicle that is not known is a newcomer.
ESTABLISHED_VEHICLES: Final = 10
# Largest vote weight of a newcomer. It is below SOURCE_TRUST, so a newcomer supports no alert. The
# vehicles of a cell that are not trusted together count less than two votes.
NEWCOMER: Final = 0.4
# Smallest weight with which a vehicle is trusted. A less trusted one votes but supports no alert.
SOURCE_TRUST: Final = 0.5
# P(slippery) of a single report, under the uniform prior, from which it may be a source of ice. The
# report must also give EVIDENCE_NATS.
SOURCE_SHARE: Final = 0.6
# [ns] Time for which a source counts. Older reports of ice are about an earlier state of the road.
SOURCE_NS: Final = 3600 * NS
# [ns] Trust is computed once per epoch and used from the next epoch on. So it depends on the order
# of the times of reports, and not on their order of arrival.
EPOCH_NS: Final = 60 * NS

# ====== Guards: limits that keep single errors and rounding from spreading ======

# --- Error of one vehicle ---

# Smallest contamination of a vehicle that agreed with many others. Its contamination is then the
# share of comparisons in which it disagreed, but not less than this. The rest stands for positions
# in the wrong cell and for the first failure of a sensor that never failed before.
CONTAMINATION_LEAST: Final = 0.04

# --- Error that all vehicles in a place share (same manoeuvre, tyre model, ruts) ---

# Largest relative standard deviation of the tyre-curve error. Of 60 tuning fleets on winter tyres
# that drove gently through a wet curve, 8 raised a false alert with .25, 3 with .275, 2 with .3.
# The limit takes effect only for tyres whose curve is unknown or round.
SHARED_MOST: Final = 0.275
# A value from gentle driving gets at least the square of this as its weight in the cell's means.
SHARED_LEAST: Final = 0.25

# --- Evidence from slippery neighbouring cells, see `neighbours` ---

# Largest factor by which a measured neighbour raises or lowers the probability of a friction, and
# least factor by which a measured belief exceeds its prior. What a cell's own visitors measured is
# refined and never replaced. With one cell on each side and 2.5 or 4, known road-hours were .509
# and .522, and the error was .0900 and .0922.
HEARD_MOST: Final = 2.5
# A cell whose P(slippery) is this close to 0 or 1 gets no messages. The reports of its own visitors
# decide, and reading the map takes less time.
DECIDED: Final = 0.001

# --- Change of a road with time ---

# Smallest probability of a sudden change that is assumed before each new value. Visits may follow
# each other within a second, and the road may still change between them; with this, two passes
# reverse a firm belief. In a tuning fleet in which every pass used all the grip, ice was found
# after 6 passes (95 % quantile 8) with .003, and after 5 (6) with .01. False ice of three fleets
# and the figures of attacks, drives and value did not change. Bounds do not assume such a change,
# so that no number of bounds erases a belief.
CHANGE_LEAST: Final = 0.01
# [s] Beliefs are aged in steps of at least this length. A shorter step would be lost in rounding to
# 16 bits. One step moves an interval by less than a tenth of a bin.
FORGET_S: Final = 10.0

# --- Repeated reports of one vehicle in one cell ---

# Number of visits of one vehicle to one cell that the lateness window holds. Further visits are
# archived and not fused. Only six visits REVISIT_S apart fit into a window of two minutes, and the
# votes of all others would weigh almost nothing.
WAITING_MOST: Final = 32
# [s] Time between two deletions of reports too old to remember, so that at most a quarter more than
# needed is stored (`table.places_for`).
FORGOTTEN_EVERY_S: Final = int(VOTE_RENEWAL_S) // 4

# --- From a report to a likelihood ---

# Largest grip used that is believed. Of the reports above it, 29 % were too high by more than .05.
UTILISED_MOST: Final = 0.9

# --- Trust: comparison of values of different vehicles in the same cell ---

# Smallest weight of another vehicle in this mean, so that comparisons count even if no vehicle is
# trusted.
TRUST_HEARD_LEAST: Final = 0.2
