"""The numbers of the fusion, each with its reason. `fleet_service/fusion/README.md` holds the mathematics."""

from __future__ import annotations

from typing import Final

from schemas import mugrid
from schemas.thresholds import EXCITED_SHARE, NS, SLIPPERY_MU

BIN_WIDTH: Final = (mugrid.UPPER - mugrid.LOWER) / mugrid.BINS

# Share of reports that say nothing about the road (faulty sensor, wrong cell, wrong tyre model): bounds what one vote
# can do to a factor of about 60. Fixes in the wrong cell alone are 12 % at the border of a surface.
CONTAMINATION: Final = 0.15

# A vehicle's own error: tyres, mass and stiffness off by a few per cent move all its values the same way. It does not
# average out over its visits, so it widens every vote; only other vehicles narrow it.
BIAS_RELATIVE: Final = 0.05
BIAS_ABSOLUTE: Final = 0.01  # .015 of a vehicle, less what half a bin adds by itself

# A vehicle that agreed with many others is wrong as seldom as it was found wrong, but never less than this: fixes in
# the wrong cell, and what a sensor does that never failed before.
CONTAMINATION_LEAST: Final = 0.04
# No bias is believed beyond this, about three standard deviations of tyres, mass and radius together.
BIAS_MOST: Final = 0.15
BIAS_KNOWN_LEAST: Final = 0.03  # ... nor to be known better: tyres warm up and wear, loads change
FLEET_BIAS: Final = 0.06  # standard deviation of the fleet's biases, before anybody was met
# ... of those of one kind of tyres against others: on wet and cold road summer and winter tyres differ by a tenth.
TYRE_BIAS: Final = 0.05
TYRE_SLOPE_STD: Final = 0.15  # ... and of its slope about the fleet's: blocks and sipes make a tread softer

# An error that all vehicles of a place share (the same manoeuvre, the same tyre model, the same ruts) does not average
# out however many they are; see `shared`. Without a value:
COMMON_RELATIVE: Final = 0.04
# ... and what does not grow with the grip: crossfall (a road has 2.5 %), slope that no filter knows, drag that is
# taken for a tyre's force. Of cells on ice (μ ≤ .2) of five tuning ways the intervals held .80 with .01, .86 with .02.
COMMON_ABSOLUTE: Final = 0.02
# ... of what reads high, which is more: of ice a seventh of the visits tell a grip that lay beside it, in the same cell
# or the one before. Of towns with the errors of four tuning ways the intervals held .78 of the ice with .02 for both,
# .81 with this, and no less of anything else.
COMMON_HIGH: Final = 0.025
# ... with values: what every manoeuvre shares, and what one kind of it does.
COMMON_ALWAYS: Final = 0.02
COMMON_MANOEUVRE: Final = 0.05
# ... and with the shape of the tyre, where less than SHARED_SHARE of a road's grip was used: relative, downward.
SHARED_SHARE: Final = 0.8
# More for it costs: with a slope of .5 the interval score of three rough ways after twenty minutes was .63 and not .55.
SHARED_SLOPE: Final = 0.25
SHARED_MOST: Final = 0.2
# ... and where the slope of the fleet's values has been found (SLOPE_KNOWN), what is left of the doubt: one slope
# is not right for every tyre and surface.
SHARED_KNOWN_SLOPE: Final = 0.1
# ... but who raises an alarm bears more doubt: with the map's own slope 3 fleets of 12 that took a wet curve gently, on
# winter tyres, made a false alert, with this none. The most of it decides how much ice stays without an alert in a
# clean fleet (of cell-minutes, three towns): none with .23, where 1 fleet of 12 was false; .02 with .26; .06 with .35.
ALERT_SLOPE: Final = 0.5
ALERT_MOST: Final = 0.25
# ... but not where so many vehicles with a record told of the ice and the slope of the fleet's values is known so well:
# with the doubt for all, ice stayed without an alert in 1.1 % of a clean fleet's cell-minutes, and so in .2 %. A record
# alone is not enough: sixty who do the same agree among each other, and 5 of 20 such fleets made a false alert.
KNOWN_SOURCES: Final = 2
SLOPE_KNOWN: Final = 0.05
SHARED_LEAST: Final = 0.25  # share of a full weight, by its root, that a gentle value has at least
SHARED_WIDE: Final = 0.1  # relative standard deviation at which a value has half the weight of a sharp one
SHARED_PART: Final = 0.2  # of the stated variance that does not show between who did the same
SHARED_ALWAYS: Final = 0.5  # part of what is shared that other manoeuvres do not average out: correlations .6 and .4

# What slippery neighbours tell, see `neighbours`: P(the next cell has the same surface). A stretch is then five cells
# long on average: patches of ice are some 40 m, drawn towns' surfaces five to ten cells. The interval score of five
# tuning ways was .59, .59, .58 with .75, .8, .85; the next surface begins within four cells in the campaign's towns.
SAME_SURFACE: Final = 0.8
NEIGHBOURS: Final = 4  # cells before and behind that may tell: .4 of a message is left
# ... and it tells in the measure in which it is slippery with more than this, the prior's and a little. Counting what
# lies up to .5 as half slippery told more of snow of .39, but winter tyres that read wet road a little low told each
# other of ice: the worst bin of P(slippery) of that fleet was .25, and so it is .05.
NEIGHBOUR_SURE: Final = 0.35
NEIGHBOUR_GRIP: Final = 0.1  # a neighbour that is slippery with less than this ends the stretch
DECIDED: Final = 0.001  # a cell with so little doubt is not asked again: three messages are worth some thousand

# A road changes slowly (drying, polishing): random walk of μ, standard deviation after one hour.
DRIFT_PER_ROOT_HOUR: Final = 0.04

# ... and at once (ice, snow, a gritter): mean time between changes that leave nothing of what was known. With three
# hours a lonely measurement fades within a day.
CHANGE_S: Final = 10800.0
# Visits may follow each other within the second, and a road may change between them: a new value always finds this much
# chance of it: three passes turn a firm belief. Lower bounds do not: however many there are, they wear nothing away.
CHANGE_LEAST: Final = 0.003

# Time is let pass over a belief in portions of this length: shorter ones would be lost in the rounding of its 16 bits,
# and none moves an interval by a tenth of a bin.
FORGET_S: Final = 10.0

# A vehicle's vote in a cell counts again in the measure in which the map forgets the first one, by drift as by change;
# so that no vehicle can hold a cell by driving over it all day.
VOTE_RENEWAL_S: Final = 3600.0

# ... or at once, if it says something else: its own bias cancels in the difference to its own last vote. From two
# standard deviations (noise) to four (certainly new); no sender's own spread is believed to be below NOVELTY_STD.
NOVELTY_FROM: Final = 2.0
NOVELTY_FULL: Final = 4.0
NOVELTY_STD: Final = 0.05
# So many whole votes a vehicle has in a cell per VOTE_RENEWAL_S, however often it changes its mind: one and one change.
# With one and a half, ice takes four passes to be seen instead of three.
VOTES: Final = 2.0
# ... and only at a visit of its own: nobody drives round a block in less. So a flood of reports is one report.
REVISIT_S: Final = 20.0
# ... and so many visits of one vehicle to one cell are kept for the window; more are archived and not fused. Six visits
# of their own fit into it (REVISIT_S), and their votes would be worth nothing.
WAITING_MOST: Final = 32
# So long a vehicle's visits to a cell are remembered, to the hour: by then 95 % of its vote count again (1 - e⁻³), and
# memory is the vehicles of an eighth of a day and not of a year.
FORGOTTEN_S: Final = 3 * 3600.0
# For a lower bound, "something else" is this much more grip used.
NOVELTY_UTILISED: Final = 0.10

# An unexcited visit should be flat above the grip it used; senders agree within half a nat (contract of the
# log-likelihood), so a fall towards the upper end of less than twice that is taken as flat: a bound, not a value.
VALUE_DROP_NATS: Final = 1.0
VALUE_DROP_STEPS: Final = int(VALUE_DROP_NATS * mugrid.STEPS_PER_NAT)

# A fix's error spreads a visit over the cells before and behind: each gets the vote in the measure in which the vehicle
# was there. Shares below this stay with the visit's own cell: receivers of 1.5 m leave 6 % to each side, which is part
# of CONTAMINATION, and thrice the votes would say nothing more.
SPREAD_LEAST: Final = 0.08
SPREAD_CELLS: Final = 2  # to each side; who is further off has no position
HERE_SHARE: Final = 0.5  # more probably here than elsewhere: counts as a visit, and is held against others'

# A posterior (μ, interval) is a value only where this share of μ was used (contract), else a lower bound.
VALUE_UTILISATION: Final = EXCITED_SHARE
UTILISED_STD: Final = 0.05  # error of the grip used: accelerometer and load transfer, about 5 % of g ...
UTILISED_RELATIVE: Final = 0.05  # ... and 5 % of itself: mass over the wheels, roll, gain
UTILISED_MOST: Final = 0.9  # ... and is not believed beyond: of what was above, 29 % was too much by more than .05
# Share of bounds that are of another road, or are no bound: on two rough ways 2 to 6 % were too high by more than .1,
# and where the surface changes within a cell all of them.
BOUND_CONTAMINATION: Final = 0.3
POSTERIOR_STD: Final = 0.15  # of a posterior without an interval: as wide as wet is from dry
POSTERIOR_STD_LEAST: Final = 0.02  # half a bin: the grid cannot hold less

# Slippery is μ below this (contract of p_slippery).
SLIPPERY: Final = SLIPPERY_MU

# Trust: two values agree up to 2.5 standard deviations of their difference (bias included) and disagree from 4 on.
# Honest vehicles then agree in 95 % of their meetings (fixes in the wrong cell, roads that change), whatever the road.
PEERS_AGREE: Final = 2.5
PEERS_DISAGREE: Final = 4.0
PEER_S: Final = 900  # values further apart in time may both be right
PEER_STD: Final = 0.25  # wider ones agree with everything
# Meetings with one vehicle after which the old count half: who was honest and begins to lie is seen in minutes, and a
# repaired sensor as soon; the mean over many others keeps it quiet.
PEER_MEMORY: Final = 3.0
REPORTERS: Final = 6  # last values of a cell that a new one is held against
PEERS: Final = 48  # places for others: a sample, which is enough for a mean
# As a mean over others, beginning with TRUST_PRIOR_PEERS imagined ones that agreed in TRUST_PRIOR. No weight is left to
# who disagrees with 30 % of those that are trusted; with less than a third of a fleet colluding that is the colluders.
TRUST_PRIOR: Final = 0.85
TRUST_PRIOR_PEERS: Final = 8.0
TRUST_NONE: Final = 0.7
TRUST_FULL: Final = 0.9
# How much too low a value is for each μ that was left, before the fleet told. Only values that state less than this
# relative variance (a standard deviation of 17 %) tell: others have the tyre's shape in what they state.
SHAPED_VARIANCE: Final = 0.03
USED_NOISE: Final = 0.04  # of the grip used, relative: as much less of its differences' squares is real
USED_NOISE_ABSOLUTE: Final = 0.02  # ... and what an accelerometer adds on any road: .2 m/s²
SLOPE_MEMORY: Final = 300.0  # squares by weight beyond which old ones count half: some two hundred comparisons
SLOPE_PRIOR: Final = 0.0
SLOPE_STD: Final = 0.15  # so sure is that: as some twenty comparisons
SLOPE_MOST: Final = 0.85  # then a value tells of little more than what was used
BIAS_PAIR: Final = 0.04  # of a pair's mean difference: what its few meetings had in common
BIAS_MEMORY: Final = 4000.0  # inverse variance of a pair's difference beyond which old meetings count half: some thirty
# Only who is trusted more than anybody is at first tells of others' errors: no liar in a service's first minutes.
TELLING_TRUST: Final = 0.85
# Who does the same as another, with a difference of the grip used of less than so much of μ.
ALIKE_USED: Final = 0.15
# On three rough drives the values of who did the same scattered by .2 to .4 of the variance that they state, and erred
# by all of it: 60 % of it was shared. So a fleet that nobody knows is taken to share half.
SPREAD_FIRST: Final = 0.7
SPREAD_FLOOR: Final = 0.5
SPREAD_CEILING: Final = 3.2
SPREAD_PRIOR: Final = 0.05  # sum of stated relative variances that is imagined as right: some five comparisons
SPREAD_MEMORY: Final = 1.0  # ... beyond which old ones count half: some hundred
TRUST_HEARD_LEAST: Final = 0.2  # how much a vehicle's word about others counts at least: all distrusted is no end
# Once so many vehicles are known (met so many others, and are trusted), one that is not is a newcomer: it votes with
# this weight, is no corroborating source, and shares one vote per cell with all others that are not trusted.
ESTABLISHED_PEERS: Final = 4.0
ESTABLISHED_VEHICLES: Final = 10
NEWCOMER: Final = 0.4
SOURCE_TRUST: Final = 0.5  # less trusted vehicles vote, but are no corroborating sources for an alert
SOURCE_SHARE: Final = 0.6  # P(slippery) from the vote alone, against the uniform prior, that makes a source of ice
# A vehicle without a record is a source of ice only if it used this share of what it says: sixty cars on winter tyres
# who all took a wet curve with a third of its grip said ice, having used six tenths of that. (.75 for all, record or
# not: 9 false alerts of 20 fleets, and ice without an alert in 5 % of cell-minutes instead of .2 %.)
WITNESS_SHARE: Final = 0.8
# A bound is a source of grip from this much grip used on: only a dry road gives it. On the best roads values lie at
# the grid's end and are bounds, and without them nobody would clear an alert there.
SOURCE_USED: Final = EXCITED_SHARE

# Trust acts from the next epoch on, so that it depends on the order of time and not of arrival.
EPOCH_NS: Final = 60 * NS
