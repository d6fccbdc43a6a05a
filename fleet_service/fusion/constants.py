"""Constants of the fusion (the map's computation from the reports of all vehicles), each with the
reason for its value. `fleet_service/fusion/README.md` explains the mathematics.
"""

from __future__ import annotations

from typing import Final

from schemas import mugrid
from schemas.thresholds import NS

BIN_WIDTH: Final = (mugrid.UPPER - mugrid.LOWER) / mugrid.BINS

# Share of reports that say nothing about the road (faulty sensor, wrong cell, wrong tyre model):
# bounds what one vote can do to a factor of about 60. Fixes in the wrong cell alone are 12 % at the
# border of a surface.
CONTAMINATION: Final = 0.15

# A vehicle's own error: tyres, mass and stiffness off by a few per cent move all its values the
# same way. It does not average out over its visits, so it widens every vote; only other vehicles
# narrow it. It is not learned per vehicle: on three tuning towns a fleet and three tuning ways that
# changed interval scores by 3 % (half biased fleet: 7 %).
BIAS_RELATIVE: Final = 0.05
BIAS_ABSOLUTE: Final = 0.01  # .015 of a vehicle, less what half a bin adds by itself

# A vehicle that agreed with many others is wrong as seldom as it was found wrong, but never less
# than this: fixes in the wrong cell, and what a sensor does that never failed before.
CONTAMINATION_LEAST: Final = 0.04

# An error that all vehicles of a place share (the same manoeuvre, the same tyre model, the same
# ruts) does not average out however many they are; see `shared`. Without a value:
COMMON_RELATIVE: Final = 0.04
# ... and what does not grow with the grip: crossfall (a road has 2.5 %), slope that no filter
# knows, drag that is taken for a tyre's force. Of cells on ice (μ ≤ .2) of five tuning ways the
# intervals held .80 with .01, .86 with .02.
COMMON_ABSOLUTE: Final = 0.02
# ... of what reads high, which is more: of ice a seventh of the visits tell a grip that lay beside
# it, in the same cell or the one before. Of towns with the errors of four tuning ways the intervals
# held .78 of the ice with .02 for both, .81 with this, and no less of anything else.
COMMON_HIGH: Final = 0.025
# ... with values: what every manoeuvre shares, and what one kind of it does.
COMMON_ALWAYS: Final = 0.02
COMMON_MANOEUVRE: Final = 0.05
# ... and with the shape of the tyre, where less than SHARED_SHARE of a road's grip was used:
# relative, downward.
SHARED_SHARE: Final = 0.8
# It is as much as vehicles differ from themselves with the grip that they use, and SHAPE_DOUBT for
# tyres and surfaces of other shapes. It widens intervals upwards and corrects no value. At most
# this much. Of 60 tuning fleets that took a wet curve gently, on winter tyres, 8 made a false alert
# with .25, 3 with .275 and 2 with .3. It binds for tyres of an unknown or a round shape only.
SHARED_MOST: Final = 0.275
SHAPE_DOUBT: Final = 0.1
SHAPE_PRIOR: Final = 0.15
SHAPE_STD: Final = 0.15  # so sure is that: as some twenty comparisons
# squares by weight beyond which old ones count half: some two hundred comparisons
SHAPE_MEMORY: Final = 300.0
SHARED_LEAST: Final = 0.25  # share of a full weight, by its root, that a gentle value has at least
# relative standard deviation at which a value has half the weight of a sharp one
SHARED_WIDE: Final = 0.1
SHARED_PART: Final = 0.1  # of the stated variance: errors that vehicles of a place have in common
# part of what is shared that other manoeuvres do not average out: correlations .6 and .4
SHARED_ALWAYS: Final = 0.5

# What slippery neighbours tell, see `neighbours`: P(the next cell has the same surface). Of three
# tuning ways the Brier score of P(slippery) was .0526 with .8, .0471 with .9.
SAME_SURFACE: Final = 0.9
NEIGHBOURS: Final = 4  # cells before and behind that may tell
NEIGHBOUR_GRIP: Final = 0.1  # a neighbour that is slippery with less than this ends the stretch
# a cell with so little doubt is not asked again: three messages are worth some thousand
DECIDED: Final = 0.001

# A road changes slowly (drying, polishing): random walk of μ, standard deviation after one hour.
DRIFT_PER_ROOT_HOUR: Final = 0.04

# ... and at once (ice, snow, a gritter): mean time between changes that leave nothing of what was
# known. With three hours a lonely measurement fades within a day.
CHANGE_S: Final = 10800.0
# Visits may follow each other within the second, and a road may change between them: a new value
# always finds this much chance of it: two passes turn a firm belief. With .003, ice where all
# pass at the limit was found after 6 passes (p95 8) of a tuning fleet, with .01 after 5 (6); false
# ice of three fleets, attacks, ways and value figures are the same. Lower bounds do not: however
# many there are, they wear nothing away.
CHANGE_LEAST: Final = 0.01

# Time is let pass over a belief in portions of this length: shorter ones would be lost in the
# rounding of its 16 bits, and none moves an interval by a tenth of a bin.
FORGET_S: Final = 10.0

# A vehicle's vote in a cell counts again in the measure in which the map forgets the first one, by
# drift as by change; so that no vehicle can hold a cell by driving over it all day.
VOTE_RENEWAL_S: Final = 3600.0

# Values so many standard deviations apart are certainly of two roads, or one of them is wrong.
PEERS_DISAGREE: Final = 4.0

# A vote counts again at once, if it says something else: its own bias cancels in the difference to
# its own last vote. From two standard deviations (noise) to PEERS_DISAGREE (certainly new); no
# sender's own spread is believed to be below NOVELTY_STD.
NOVELTY_FROM: Final = 2.0
NOVELTY_FULL: Final = PEERS_DISAGREE
NOVELTY_STD: Final = 0.05
# So many whole votes a vehicle has in a cell per VOTE_RENEWAL_S, however often it changes its mind:
# one and one change. With one and a half, ice takes four passes to be seen instead of three.
VOTES: Final = 2.0
# ... and only at a visit of its own: nobody drives round a block in less. So a flood of reports is
# one report.
REVISIT_S: Final = 20.0
# ... and so many visits of one vehicle to one cell are kept for the window; more are archived and
# not fused. Six visits of their own fit into it (REVISIT_S), and their votes would be worth
# nothing.
WAITING_MOST: Final = 32
# So long a vehicle's values in a cell are remembered: by then 95 % of its vote count again
# (1 - e⁻³). Lower bounds are remembered for VOTE_RENEWAL_S only, when 63 % count again: most visits
# give bounds, so memory is the visits of one hour and the values of three.
FORGOTTEN_S: Final = 3.0 * VOTE_RENEWAL_S
FORGOTTEN_EVERY_S: Final = 900  # time between two deletions of what is forgotten
# For a lower bound, "something else" is this much more grip used.
NOVELTY_UTILISED: Final = 0.10

# A visit without a value is evidence against slippery road where visitors gave values before: this
# share of the cell's own rate of values, since a driver who was warned uses less grip. At 20
# vehicles an hour .883 of the alerts of four tuning towns were right without it, .914 with it,
# and the same share of ice was found (.906).
SILENCE: Final = 0.4
FIRST_VISITS: Final = 4.0  # that are too few to know the rate of values
# P(slippery) down to which that may lead: no longer probable, and not improbable either
UNSURE: Final = 0.45

# An unexcited visit should be flat above the grip it used; senders agree within half a nat
# (contract of the log-likelihood), so a fall towards the upper end of less than twice that is taken
# as flat: a bound, not a value.
VALUE_DROP_NATS: Final = 1.0
VALUE_DROP_STEPS: Final = int(VALUE_DROP_NATS * mugrid.STEPS_PER_NAT)

# A fix's error spreads a visit over the cells before and behind: each gets the vote in the measure
# in which the vehicle was there. Shares below this stay with the visit's own cell: receivers of 1.5
# m leave 6 % to each side, which is part of CONTAMINATION, and thrice the votes would say nothing
# more.
SPREAD_LEAST: Final = 0.08
SPREAD_CELLS: Final = 2  # to each side; who is further off has no position
# more probably here than elsewhere: counts as a visit, and is held against others'
HERE_SHARE: Final = 0.5

# error of the grip used: accelerometer and load transfer, about 5 % of g ...
UTILISED_STD: Final = 0.05
# ... and of itself as much as a value: mass over the wheels, roll, gain
UTILISED_RELATIVE: Final = BIAS_RELATIVE
# ... and is not believed beyond: of what was above, 29 % was too much by more than .05
UTILISED_MOST: Final = 0.9
# Share of bounds that are of another road, or are no bound: on two rough ways 2 to 6 % were too
# high by more than .1, and where the surface changes within a cell all of them.
BOUND_CONTAMINATION: Final = 0.3
POSTERIOR_STD: Final = 0.15  # of a posterior without an interval: as wide as wet is from dry
POSTERIOR_STD_LEAST: Final = 0.02  # half a bin: the grid cannot hold less

# Trust: two values agree up to 2.5 standard deviations of their difference (bias included) and
# disagree from PEERS_DISAGREE on. Honest vehicles then agree in 95 % of their meetings (fixes in
# the wrong cell, roads that change), whatever the road.
PEERS_AGREE: Final = 2.5
PEER_S: Final = 900  # values further apart in time may both be right
PEER_STD: Final = 0.25  # wider ones agree with everything
# Meetings with one vehicle after which the old count half: who was honest and begins to lie is seen
# in minutes, and a repaired sensor as soon; the mean over many others keeps it quiet.
PEER_MEMORY: Final = 3.0
REPORTERS: Final = 6  # last values of a cell that a new one is held against
PEERS: Final = 48  # places for others: a sample, which is enough for a mean
# As a mean over others, beginning with TRUST_PRIOR_PEERS imagined ones that agreed in TRUST_PRIOR.
# No weight is left to who disagrees with 30 % of those that are trusted; with less than a third of
# a fleet colluding that is the colluders.
TRUST_PRIOR: Final = 0.85
TRUST_PRIOR_PEERS: Final = 8.0
TRUST_NONE: Final = 0.7
TRUST_FULL: Final = 0.9
# how much a vehicle's word about others counts at least: all distrusted is no end
TRUST_HEARD_LEAST: Final = 0.2
# Once so many vehicles are known (met so many others, and are trusted), one that is not is a
# newcomer: it votes with this weight, is no corroborating source, and shares one vote per cell with
# all others that are not trusted.
ESTABLISHED_PEERS: Final = 4.0
ESTABLISHED_VEHICLES: Final = 10
NEWCOMER: Final = 0.4
# less trusted vehicles vote, but are no corroborating sources for an alert
SOURCE_TRUST: Final = 0.5
# P(slippery) from the vote alone, against the uniform prior, that makes a source of ice
SOURCE_SHARE: Final = 0.6
# ... and its evidence for ice against grip, in nats, with the doubt about the shape of its tyres.
# Of the visits to ice (< .25) of two tuning ways 20 % have 1.5 nats and 12 % three; of those to wet
# road .6 % and .2 %, to dry road .08 % and .04 %. With two instead of one, alerts of three ways
# found .13 of the snow instead of .17, and as much ice (.80).
WITNESS_NATS: Final = 1.0
# Trust acts from the next epoch on, so that it depends on the order of time and not of arrival.
EPOCH_NS: Final = 60 * NS
