"""Evaluation under realistic conditions: hilly towns whose cars have large sensor errors, as real
cars have, and cars that stand on a slope. Every estimator is evaluated.

Towns (friction, hills), cars, sensors and clocks are drawn randomly by the seed; half of the cars
have no torque signal. Results for towns are means over the samples of all towns together.

Terms
    surface       class of the mean friction of the four wheels: ice up to .2, snow up to .45, wet
                  up to .75, dry above
    excited       a sample is excited if a wheel used at least EXCITED_SHARE (.6) of its available
                  friction within the last second
    called ice    a sample is called ice if the estimator's probability P(mu < SLIPPERY_MU) is above
                  CALLED_SHARE (.9)

Results
    missed ice    share of the excited samples on ice that are not called ice
    false grip    share of the samples on ice for which the lower end of the estimated friction
                  interval is more than FALSE_GRIP (.05) above the true friction
    false ice     share of the samples on wet and dry road that are called ice
    settled       false ice, without the samples within SETTLED_S (3 s) after the car has left snow
                  or ice, because an estimator notices the end of the ice only when grip is used
    off_ice       false ice, without the samples in which a wheel is on snow or ice. The front axle
                  reaches ice first, and the mean friction of the wheels is then still high.
    of_all        share of all samples that are called ice although the true friction is above
                  SURE_GRIP (.6)
    below         share of all samples whose friction interval is certainly wrong, because its upper
                  end is below the grip that the car uses
    contradiction share of the samples with the health flag CONTRADICTION: no friction explains the
                  data
    lost          share of the samples with a speed error above LOST_M_S (1 m/s)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from edge_agent.app.estimator_factory import bank_of
from edge_agent.estimators import Estimates
from edge_agent.lab.evaluation.batch import (
    USUAL,
    DriveSet,
    DriveSpec,
    run_estimator,
    simulate_realistic,
)
from edge_agent.lab.evaluation.measures import is_covered, motion_errors
from edge_agent.lab.simulation import PRESETS, SimulatedFleet
from edge_agent.lab.simulation.scenarios import drawn_town, winter, with_cobbles
from schemas.errors import InputError
from schemas.mugrid import LOWER, UPPER
from schemas.numeric import BoolArray, FloatArray
from schemas.signals import Health, S, per_wheel
from schemas.thresholds import (
    CALLED_SHARE,
    EXCITED_SHARE,
    GRAVITY,
    SURFACES,
    UTILISED_WINDOW_S,
    Z_95,
)

LOST_M_S: Final = 1.0
FALSE_GRIP: Final = 0.05
MISS: Final = 20.0  # 2/α in the interval score of Gneiting and Raftery (2007) for 90 % intervals
# 90 % interval of the uniform prior
PRIOR: Final = (LOWER + 0.05 * (UPPER - LOWER), UPPER - 0.05 * (UPPER - LOWER))
NOISE: Final = 0.03  # noise of the grip in use, which is smoothed over SMOOTH_S
SURE_GRIP: Final = 0.6
SETTLED_S: Final = 3.0
SMOOTH_S: Final = 0.2
RATE_HZ: Final = 100.0
TOWN_CARS = 16
TOWN_S = 120.0
TOWNS = 5
STANDING_S: Final = 70.0
STANDING_SLOPES: Final = (0.05, 0.08)


@dataclass
class Tally:
    """Sums and counts of the evaluation's measures over samples, by name of the measure: `add` adds
    values, and `means` returns the mean of each measure.
    """

    total: dict[str, float] = field(default_factory=dict)
    count: dict[str, int] = field(default_factory=dict)

    def add(self, name: str, value: FloatArray | BoolArray, among: BoolArray | None = None) -> None:
        """Add values (T, N) to the mean of the measure called `name`. If the mask `among` (T, N) is
        given, only values where `among` is True are added. NaN values are left out.
        """
        selected = np.asarray(value, dtype=np.float64)[slice(None) if among is None else among]
        selected = selected[np.isfinite(selected)]
        self.total[name] = self.total.get(name, 0.0) + float(selected.sum())
        self.count[name] = self.count.get(name, 0) + selected.size

    def means(self) -> dict[str, float]:
        """Return the mean of the values added under each name; NaN without values.

        For a measure whose name ends in "_squared", the function returns the root of the mean,
        under the name without this suffix.
        """
        found = {
            name: total / self.count[name] if self.count[name] else np.nan
            for name, total in self.total.items()
        }
        return {
            name.removesuffix("_squared"): float(np.sqrt(mean))
            if name.endswith("_squared")
            else mean
            for name, mean in found.items()
        }


def in_winter(seed: int) -> bool:
    """Return True if the town with this seed is a winter town; all towns with an odd seed are."""
    return seed % 2 == 1


def simulate_town(
    seed: int, cars: int, seconds: float, *, cobbles: bool = False
) -> tuple[DriveSet, FloatArray]:
    """Simulate cars with large sensor errors (as in real cars) in a town drawn by the seed. Return
    their drives, and the utilisation of each car's most heavily used wheel, (T, N). Utilisation is
    the tyre force divided by the largest possible tyre force.

    In winter towns all cars have winter equipment. With `cobbles`, all roads are uneven.
    """
    cold = in_winter(seed)
    scenario = winter(seed) if cold else drawn_town(seed)
    fleet = SimulatedFleet(
        with_cobbles(scenario, seed) if cobbles else scenario,
        cars,
        seed,
        RATE_HZ,
        rough=1.0,
        winter=float(cold),
    )
    t, signals = fleet.step(round(seconds * RATE_HZ))
    true = fleet.truth
    truth = {
        f"true_{name}": getattr(true, name)
        for name in ("vx", "vy", "yaw_rate", "ax", "ay", "slope")
    }
    truth |= {name: true.mu_wheel[..., i] for i, name in enumerate(per_wheel("true_mu"))}
    return DriveSet(t, signals, truth, fleet.vehicles), true.utilisation.max(axis=-1)


def in_use(batch: DriveSet) -> FloatArray:
    """Return the grip that each car uses in total, (T, N) [1]: true horizontal acceleration divided
    by g, averaged over a short time, minus an allowance for noise.
    """
    used = np.hypot(batch.truth["true_ax"], batch.truth["true_ay"]) / GRAVITY
    width = max(1, round(SMOOTH_S * RATE_HZ))
    summed = np.cumsum(np.concatenate([np.zeros((width, used.shape[1])), used]), axis=0)
    return np.asarray((summed[width:] - summed[:-width]) / width - NOISE)


def recent_maximum(used: FloatArray | BoolArray, seconds: float = UTILISED_WINDOW_S) -> FloatArray:
    """Return the moving maximum of `used` over the last `seconds`, (T, N). `used` (T, N) is a
    quantity at T samples of N cars, for example the share of the available friction that a car
    uses [1]. In a mask, True counts as 1.
    """
    samples = round(seconds * RATE_HZ)
    padded = np.concatenate([np.zeros((samples - 1, used.shape[1])), used])
    return np.asarray(
        np.lib.stride_tricks.sliding_window_view(padded, samples, axis=0).max(axis=-1)
    )


def interval_score(lower: FloatArray, upper: FloatArray, truth: FloatArray) -> FloatArray:
    """Return the interval score of each sample, in the arrays' common shape: width of the interval
    plus, if the true value lies outside, MISS times its distance from the interval. The score
    rewards narrow intervals that contain the true value.
    """
    return np.asarray(
        upper - lower + MISS * (np.maximum(lower - truth, 0.0) + np.maximum(truth - upper, 0.0))
    )


def tally_town(tally: Tally, batch: DriveSet, reported: Estimates, used: FloatArray) -> None:
    """Add an estimator's results in one town to `tally` (the sums from which its means are
    computed).
    """
    mu = batch.mu
    inside = is_covered(batch, reported)
    width = reported.mu_upper - reported.mu_lower
    excited = recent_maximum(used) >= EXCITED_SHARE
    tally.add("coverage90", inside)
    for name, (above, most) in SURFACES.items():
        tally.add(f"coverage90.{name}", inside, (mu > above) & (mu <= most))
    tally.add("coverage90.excited", inside, excited)
    contradicted = (reported.health.astype(np.int64) & Health.CONTRADICTION) > 0
    tally.add("contradiction_share", contradicted)
    for name, (above, most) in SURFACES.items():
        for kind, among in (("excited", excited), ("calm", ~excited)):
            tally.add(
                f"contradiction_share.{name}.{kind}",
                contradicted,
                (mu > above) & (mu <= most) & among,
            )
    tally.add(
        "coverage90.no_torque", inside[:, np.isnan(batch.signals[:, :, S.TORQUE]).all(axis=0)]
    )
    icy = reported.p_slippery > CALLED_SHARE
    grips = mu > SURFACES["wet"][0]
    ice = mu <= SURFACES["ice"][1]
    tally.add("missed_ice", ~icy, ice & excited)
    tally.add("false_grip", reported.mu_lower > mu + FALSE_GRIP, ice)
    tally.add("false_ice", icy, grips)
    tally.add("false_ice.off_ice", icy, batch.mu_wheel.min(axis=-1) > SURFACES["wet"][0])
    tally.add("false_ice.of_all", icy & (mu > SURE_GRIP))
    tally.add("false_ice.settled", icy, grips & ~recent_maximum(~grips, SETTLED_S).astype(bool))
    tally.add("below", reported.mu_upper < in_use(batch))
    tally.add("width", width / (PRIOR[1] - PRIOR[0]), excited)
    tally.add("width.all", width / (PRIOR[1] - PRIOR[0]))
    tally.add("score", interval_score(reported.mu_lower, reported.mu_upper, mu))
    off = motion_errors(batch, reported)
    for name, std in (("vx", reported.vx_std), ("vy", reported.vy_std)):
        tally.add(f"rmse_{name}_squared", off[name] ** 2)
        tally.add(f"coverage90.{name}", np.abs(off[name]) <= Z_95 * std)
    tally.add("lost", np.abs(off["vx"]) > LOST_M_S)


def tally_baseline(tally: Tally, batch: DriveSet) -> None:
    """Add two baselines to `tally` (sums of the evaluation): the interval score of the friction
    prior, and the error of the mean wheel speed as an estimate of v_x.
    """
    radius = np.array([vehicle.wheel_radius for vehicle in batch.vehicles])
    off = (
        radius * np.nanmean(batch.signals[:, :, S.OMEGA : S.OMEGA + 4], axis=-1)
        - batch.truth["true_vx"]
    )
    tally.add("rmse_vx_squared", off**2)
    tally.add("lost", np.abs(off) > LOST_M_S)
    lower, upper = (np.full(batch.mu.shape, end) for end in PRIOR)
    tally.add("score", interval_score(lower, upper, batch.mu))


def simulate_standing(slope: float, seeds: Sequence[int], seconds: float) -> list[DriveSet]:
    """Simulate cars of all vehicle presets that stand on a slope of `slope` [1]. Some have ordinary
    sensors, and some have large sensor errors (as real cars have) and no torque signal.
    """
    batches = []
    for sensors in (USUAL, "rough"):
        for k, preset in enumerate(PRESETS.values()):
            drive = DriveSpec(
                "standing", preset, duration_s=seconds, slope=slope, torque=sensors == USUAL
            )
            batches.append(
                simulate_realistic(drive, seeds[k :: len(PRESETS)] or seeds[:1], sensors)
            )
    return batches


def largest_speed(estimator: str, batches: Sequence[DriveSet]) -> float:
    """Return the largest speed [m/s], in any direction, that the estimator reports for cars that
    stand.
    """
    reported = [run_estimator(bank_of(estimator, batch.vehicles), batch) for batch in batches]
    return max(float(np.hypot(each.vx, each.vy).max()) for each in reported)


@dataclass
class RealWorldResults:
    """Results of the evaluation by estimator and name, and one drive to plot. The entry "baseline"
    is for comparison: v_x is the wheels' mean speed, and the friction interval is the prior's.
    """

    measures: dict[str, dict[str, float]]
    batch: DriveSet
    reported: dict[str, Estimates]


def run_real_world_campaign(
    seeds: Sequence[int], estimators: Sequence[str], *, quick: bool
) -> RealWorldResults:
    """Run towns whose cars have large sensor errors, and cars that stand on slopes, for every
    estimator. The first town is stored for plots.
    """
    cars, seconds, towns = (4, 15.0, 1) if quick else (TOWN_CARS, TOWN_S, TOWNS)
    tallies = {name: Tally() for name in (*estimators, "baseline")}
    world = None
    for seed in seeds[:towns]:
        batch, used = simulate_town(seed, cars, seconds)
        tally_baseline(tallies["baseline"], batch)
        world = world or RealWorldResults({}, batch, {})
        for name in estimators:
            reported = run_estimator(bank_of(name, batch.vehicles), batch)
            tally_town(tallies[name], batch, reported, used)
            world.reported.setdefault(name, reported)
    if world is None:
        raise InputError("seeds", "are none", "give at least one")
    world.measures = {name: tally.means() for name, tally in tallies.items()}
    for slope in STANDING_SLOPES:
        batches = simulate_standing(slope, seeds, 10.0 if quick else STANDING_S)
        for name in estimators:
            world.measures[name][f"standing_{100 * slope:.0f}pct.v_max"] = largest_speed(
                name, batches
            )
    return world
