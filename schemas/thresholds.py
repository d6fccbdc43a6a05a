"""Numbers that several packages must agree on; each is defined only here. The mark "(contract)"
means that the number belongs to the definition of messages between vehicles, service and clients.

EXCITED_SHARE       share of the available grip μ that a vehicle must use for its value of μ to
                    count as measured, and not only as a lower bound (contract)
VALUE_NATS          a visit's likelihood gives a value of μ if it falls by at least this from its
                    maximum to the highest friction [nat]; else it is only a lower bound (contract)
UTILISED_WINDOW_S   `mu_utilised` is the largest grip used within this time [s] (contract)
SLIPPERY_MU         a road is slippery if its μ is below this: packed snow has .2–.35, wet asphalt
                    .5–.8 (Pacejka 2012, ch. 1)
CALLED_SHARE        a road is reported as slippery if P(μ < SLIPPERY_MU) is above this
CHANGE_S            mean time between sudden changes of a road (ice, snow, gritting), after which
                    older reports mean nothing [s]. With three hours, a single measurement fades
                    within a day.
SURFACES            kinds of road by their range of μ: above the first number, up to the second;
                    intervals are evaluated for each kind separately
Z_95                95 % quantile of the standard normal distribution: half the width of a 90 %
                    interval in standard deviations
GRAVITY             acceleration of gravity [m/s²], rounded; standard is 9.80665 (ISO 80000-3)
EARTH_RADIUS_M      radius of the Web Mercator sphere [m]: semi-major axis of WGS 84
METRES_PER_DEGREE   length of a degree of latitude on this sphere [m/°], rounded:
                    π/180 · EARTH_RADIUS_M
SLOWEST_HZ          smallest rate of readings of a signal that suffices for friction [1/s]
REACTION_S          reaction time of a warned driver [s] (Green, Transportation Human Factors 2,
                    2000: 1.2 to 1.5 s)
NS                  nanoseconds per second
UNKNOWN             integer in place of a cell, sector or flag that is unknown
US_STEP             nanoseconds per microsecond, the resolution of times in the archive
MU_RANGE            range of μ and of the grip used that a message may contain; no road tyre has a μ
                    above 2 (contract)
"""

from __future__ import annotations

from statistics import NormalDist
from typing import Final

EXCITED_SHARE: Final = 0.6
VALUE_NATS: Final = 1.0
UTILISED_WINDOW_S: Final = 1.0
SLIPPERY_MU: Final = 0.4
CALLED_SHARE: Final = 0.9
CHANGE_S: Final = 10_800.0
SURFACES: Final = {"ice": (0.0, 0.2), "snow": (0.2, 0.45), "wet": (0.45, 0.75), "dry": (0.75, 2.0)}
Z_95: Final = NormalDist().inv_cdf(0.95)
GRAVITY: Final = 9.81
EARTH_RADIUS_M: Final = 6_378_137.0
METRES_PER_DEGREE: Final = 111_320.0
SLOWEST_HZ: Final = 5.0
REACTION_S: Final = 1.5
NS: Final = 1_000_000_000
UNKNOWN: Final = -1
US_STEP: Final = 1_000
MU_RANGE: Final = (0.0, 2.0)
