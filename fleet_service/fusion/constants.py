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

# An error that all vehicles of a place share (the same manoeuvre, the same tyre model, the same ruts) does not average
# out however many they are. It widens every reading of the map, once. On the whole way cells of 20 and more excited
# vehicles err by 4 to 6 % about the mean of their surface; half a bin and the votes' own bias bear the rest.
COMMON_RELATIVE: Final = 0.04
COMMON_ABSOLUTE: Final = 0.01

# A visit that used less than SHAPE_SHARE of the grip reads it from the tyre's shape: relative error of the reading, by
# share used. On the whole way the likelihoods' maxima lie 13, 20, 28 and 37 % too low on dry road after visits that
# used .75, .65, .55 and .4 of the grip, and within 10 % on all surfaces from .8 on. SHAPE_MOST is less than the last
# of these: with .3 ice takes four passes instead of three.
SHAPE_SHARE: Final = 0.8
SHAPE_SLOPE: Final = 2.0
SHAPE_MOST: Final = 0.25

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
UTILISED_STD: Final = 0.05  # error of the grip used: accelerometer and load transfer, about 5 % of g
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
TRUST_HEARD_LEAST: Final = 0.2  # how much a vehicle's word about others counts at least: all distrusted is no end
# Once so many vehicles are known (met so many others, and are trusted), one that is not is a newcomer: it votes with
# this weight, is no corroborating source, and shares one vote per cell with all others that are not trusted.
ESTABLISHED_PEERS: Final = 4.0
ESTABLISHED_VEHICLES: Final = 10
NEWCOMER: Final = 0.4
SOURCE_TRUST: Final = 0.5  # less trusted vehicles vote, but are no corroborating sources for an alert
SOURCE_SHARE: Final = 0.6  # P(slippery) from the vote alone, against the uniform prior, that makes a source of ice
# A bound is a source of grip from this much grip used on: only a dry road gives it. On the best roads values lie at
# the grid's end and are bounds, and without them nobody would clear an alert there.
SOURCE_USED: Final = EXCITED_SHARE

# Trust acts from the next epoch on, so that it depends on the order of time and not of arrival.
EPOCH_NS: Final = 60 * NS
