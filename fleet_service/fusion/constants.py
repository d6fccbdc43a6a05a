"""The numbers of the fusion, each with its reason. `fleet_service/fusion/README.md` holds the mathematics."""

from __future__ import annotations

from typing import Final

from schemas import mugrid

BIN_WIDTH: Final = (mugrid.UPPER - mugrid.LOWER) / mugrid.BINS

# Share of reports that say nothing about the road (faulty sensor, wrong cell, wrong tyre model): bounds what one vote
# can do to a factor of about 60. 10 to 20 % served a toy study with liars; the middle of it.
CONTAMINATION: Final = 0.15

# A vehicle's own error: tyres, mass and stiffness off by a few per cent move all its values the same way. It does not
# average out over its visits, so it widens every vote; only other vehicles narrow it.
BIAS_RELATIVE: Final = 0.05
BIAS_ABSOLUTE: Final = 0.02

# A road changes slowly (drying, polishing): random walk of μ, standard deviation after one hour.
DRIFT_PER_ROOT_HOUR: Final = 0.04

# ... and at once (ice, snow, a gritter): mean time between changes that leave nothing of what was known. Two hours make
# three passes enough to turn a firm belief, and a lonely measurement fade within a morning.
CHANGE_S: Final = 7200.0
# Visits may follow each other within the second, and a road may change between them: a new value always finds this much
# chance of it. Lower bounds do not: however many there are, they wear nothing away.
CHANGE_LEAST: Final = 0.003

# A vehicle's vote in a cell counts again in the measure in which the map forgets the first one; half of CHANGE_S, so
# that no vehicle can hold a cell by driving over it all day.
VOTE_RENEWAL_S: Final = 3600.0

# ... or at once, if it says something else: its own bias cancels in the difference to its own last vote. From two
# standard deviations (noise) to four (certainly new); no sender's own spread is believed to be below NOVELTY_STD.
NOVELTY_FROM: Final = 2.0
NOVELTY_FULL: Final = 4.0
NOVELTY_STD: Final = 0.05
# For a lower bound, "something else" is this much more grip used.
NOVELTY_UTILISED: Final = 0.10

# An unexcited visit should be flat above the grip it used; senders agree within half a nat (contract of the
# log-likelihood), so a fall towards the upper end of less than twice that is taken as flat: a bound, not a value.
VALUE_DROP_NATS: Final = 1.0
VALUE_DROP_STEPS: Final = int(VALUE_DROP_NATS * mugrid.STEPS_PER_NAT)

# Between the grip used and its maximum a value says "there was more than I used". That rests on the shape of the tyre
# curve, which all vehicles assume alike and which no number of them averages out; so it counts this much of its nats.
# On a simulated fleet a quarter raised the coverage of measured cells from .78 to .87 and made nothing worse.
CURVE_SHARE: Final = 0.25

# A posterior (μ, interval) is a value only where this share of μ was used (contract), else a lower bound.
VALUE_UTILISATION: Final = 0.6
UTILISED_STD: Final = 0.05  # error of the grip used: accelerometer and load transfer, about 5 % of g
POSTERIOR_STD: Final = 0.15  # of a posterior without an interval: as wide as wet is from dry
POSTERIOR_STD_LEAST: Final = 0.02  # half a bin: the grid cannot hold less

# Slippery is μ below this (contract of p_slippery).
SLIPPERY: Final = 0.4

# Trust: agreement g in (0, 1) of a value with what others said, as a Beta mean with this prior; a vehicle that agrees
# no better than chance (one half) keeps half a vote, one that disagrees most of the time none.
TRUST_AGREED: Final = 3.0
TRUST_DISAGREED: Final = 2.0
TRUST_NONE: Final = 0.3
TRUST_FULL: Final = 0.7
TRUST_MEMORY: Final = 100.0  # votes after which the old half as much: a repaired sensor is believed again
TRUST_VEHICLES: Final = 3  # a cell judges a vote only when so many vehicles were there before
WITNESS_TRUST: Final = 0.5  # less trusted vehicles vote, but do not bear witness for an alert
WITNESS_SHARE: Final = 0.6  # P(slippery) from the vote alone, against the uniform prior, that makes a witness

# Trust acts from the next epoch on, so that it depends on the order of time and not of arrival.
EPOCH_NS: Final = 60_000_000_000
