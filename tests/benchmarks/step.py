"""Benchmark of one step of a six-state filter over four tyres, compared with C and with common
filter libraries.
"""

from __future__ import annotations

import statistics
import time
from functools import partial
from importlib.util import find_spec
from typing import TypeVar

import numpy as np

from edge_agent.app.estimator_factory import bank_of
from edge_agent.app.tuned_memberships import shipped_memberships
from edge_agent.dynamics.parameters import parameter_table
from edge_agent.estimators import TUNED, Estimates, EstimatorBank
from edge_agent.lab.simulation import simulate_manoeuvre
from schemas.numeric import FloatArray
from schemas.runtime.figures import Figure
from schemas.signals import CHANNELS, S
from tests.benchmarks.limit import PARAMETERS, Limit, VectorLimit
from tests.benchmarks.measure import SEED, median_s, time_in_turn
from tests.benchmarks.peers import PEERS, PYTHON_STEPS, Problem

NAME = "paper-aco-fckf"
SAMPLES = 100_000
CALLS = 1_000  # single calls in a round
THREADS = 2
# Largest accepted difference between C and Python in v_x, v_y and yaw rate over a drive.
AGREE = 1e-6


class Drive:
    """Simulated manoeuvre in two tables. `signals` has all 18 signals, for the estimator.
    `readings` has 11 of these signals, for the filter in C. A caller can repeat the manoeuvre as
    often as needed.
    """

    def __init__(self) -> None:
        log, self.vehicle = simulate_manoeuvre("double-lane-change", seed=SEED)
        table = np.stack([log[name].to_numpy(zero_copy_only=False) for name in CHANNELS], axis=-1)
        t = log["t"].to_numpy()
        self.gone = float(t[1] - t[0])
        self.signals = np.ascontiguousarray(table)
        self.t = np.arange(len(t)) * self.gone
        self.readings = np.ascontiguousarray(
            table[
                :,
                [
                    S.AX,
                    S.AY,
                    S.YAW_RATE,
                    *range(S.DELTA, S.DELTA + 4),
                    *range(S.OMEGA, S.OMEGA + 4),
                ],
            ]
        )

    def repeat_samples(
        self, samples: int, vehicles: int
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return T samples of N vehicles: times (T, N), all signals (T, N, 18), and the readings
        (T, N, 11). The readings are those signals that the filter in C uses. The manoeuvre is
        repeated if it is shorter than T samples.
        """
        index = np.arange(samples) % len(self.t)
        t = np.repeat((np.arange(samples) * self.gone)[:, None], vehicles, axis=1)
        return (
            t,
            np.repeat(self.signals[index, None], vehicles, 1),
            np.repeat(self.readings[index, None], vehicles, 1),
        )


Kind = TypeVar("Kind", Limit, VectorLimit)


def make_limit(kind: type[Kind], drive: Drive, vehicles: int, speed: float) -> Kind:
    """Return a bank of filters in C (one per vehicle, computed together) of the class `kind`. Each
    filter starts from the first sample of `drive`.
    """
    rows = parameter_table([drive.vehicle] * vehicles)[:, :PARAMETERS]
    return kind(
        rows, np.repeat(drive.readings[:1], vehicles, 0), speed, shipped_memberships(TUNED[NAME])
    )


def same_filter(drive: Drive) -> float:
    """Check that the filters in C and in Python give the same estimates. Return the speed [m/s] at
    the first sample, with which the filter in C starts.

    Raises:
        ArithmeticError: the estimates differ.
    """
    t, signals, readings = drive.repeat_samples(len(drive.t), 1)
    estimates: Estimates = bank_of(NAME, [drive.vehicle]).advance(t, signals)
    speed = float(estimates.vx[0, 0])
    means = make_limit(Limit, drive, 1, speed).drive(readings[1:], drive.gone)[:, 0]
    ours = np.stack([estimates.vx, estimates.vy, estimates.yaw_rate], axis=-1)[1:, 0]
    apart = float(np.abs(ours - means[:, [0, 1, 4]]).max())
    if not apart < AGREE:
        raise ArithmeticError(f"the C kernel and {NAME} are {apart:g} apart: not the same filter")
    return speed


def step() -> list[Figure]:
    """Compare the time of one filter step with that of C code and of filter libraries, and measure
    the time of a call of the filter bank.
    """
    drive = Drive()
    speed = same_filter(drive)
    t, signals, readings = drive.repeat_samples(SAMPLES, 1)
    ours, scalar = time_in_turn(
        lambda: bank_of(NAME, [drive.vehicle]).advance(t, signals),
        lambda: make_limit(Limit, drive, 1, speed).drive(readings, drive.gone),
    )
    per_call = call_s(bank_of(NAME, [drive.vehicle]), t, signals)
    per_step = ours / SAMPLES
    found = [
        Figure(
            "bench.step.us",
            per_step * 1e6,
            "us, paper-aco-fckf (the default: bench.aco_fckf.us), N = 1, 100 000 samples in a call",
        ),
        Figure("bench.step.vs_c", ours / scalar, "times scalar C", 1.5),
        Figure("bench.step.call_overhead_us", (per_call - per_step) * 1e6, "us", 2),
    ]
    problem = Problem(parameter_table([drive.vehicle])[0], drive.readings, drive.gone, speed)
    for name, peer in PEERS.items():
        if find_spec(name) is None:
            print(f"  {name} is not installed: pip install '.[bench]'", flush=True)
            continue
        seconds = median_s(partial(peer.drive, problem), 3) / PYTHON_STEPS
        found.append(
            Figure(f"bench.step.vs_{name}", seconds / per_step, "times as fast", peer.bar, "more")
        )
    return found


def call_s(bank: EstimatorBank, t: FloatArray, signals: FloatArray) -> float:
    """Return the time [s] of one call of an estimator bank with one sample of each vehicle: the
    median over rounds of CALLS calls, after a warm-up.
    """
    spent = []
    for begin in range(0, SAMPLES, CALLS):
        samples = [(t[k : k + 1], signals[k : k + 1]) for k in range(begin, begin + CALLS)]
        began = time.perf_counter()
        for now, reading in samples:
            bank.advance(now, reading)
        spent.append(time.perf_counter() - began)
    return statistics.median(spent[1:]) / CALLS


def bank() -> list[Figure]:
    """Measure the time of a filter bank (filters of many vehicles, computed together).

    Compare the bank with the same filter in C, both on two threads, and with vectorised C on one
    thread. Compare also the bank's time per vehicle and sample for 100 000 vehicles with that for
    100.
    """
    drive = Drive()
    speed = same_filter(drive)
    found = []
    cost = {}
    for vehicles, samples in ((100, 1000), (1000, 200), (100_000, 4)):
        t, signals, readings = drive.repeat_samples(samples, vehicles)
        fleet = [drive.vehicle] * vehicles
        ours, threaded = time_in_turn(
            # The lambdas run within this iteration, so the loop variables are safe (B023).
            lambda: bank_of(NAME, fleet).advance(t, signals, threads=THREADS),  # noqa: B023
            lambda: make_limit(
                Limit,
                drive,
                vehicles,  # noqa: B023
                speed,
            ).drive(readings, drive.gone),  # noqa: B023
        )
        cost[vehicles] = ours / (vehicles * samples)
        if vehicles > 100:
            found.append(
                Figure(
                    f"bench.bank.vs_c_openmp.{vehicles}",
                    ours / threaded,
                    "times C on two threads",
                    1.5,
                )
            )
    found.append(
        Figure(
            "bench.bank.vs_simd_c",
            vs_simd(drive, speed),
            "times C in vectors, paper-aco-fckf, N = 1 000, one thread",
            1.6,
        )
    )
    return [
        *found,
        Figure("bench.bank.flatness", cost[100_000] / cost[100], "N = 100 000 over N = 100", 1.2),
    ]


def vs_simd(drive: Drive, speed: float, vehicles: int = 1000, samples: int = 200) -> float:
    """Return the duration of a step of the product's filter for many vehicles, divided by that of
    the same filter in C, which computes several vehicles in one SIMD vector. Both use one thread.

    Every vehicle has its own noise, so that an error that mixes up vector lanes is found.

    Raises:
        ArithmeticError: C and Python give different estimates.
    """
    t, signals, readings = drive.repeat_samples(samples, vehicles)
    noise = np.random.default_rng(SEED).normal(0.0, 0.01, (samples, vehicles, 3))
    noise[0] = 0.0
    signals[..., [S.AX, S.AY, S.YAW_RATE]] += noise
    readings[..., :3] += noise
    fleet = [drive.vehicle] * vehicles
    turned = make_limit(VectorLimit, drive, vehicles, speed).side_by_side(readings[1:])
    ours = bank_of(NAME, fleet).advance(t, signals)
    means = (
        make_limit(VectorLimit, drive, vehicles, speed).drive(turned, drive.gone).swapaxes(-1, -2)
    )
    found = np.stack([ours.vx, ours.vy, ours.yaw_rate], axis=-1)[1:]
    apart = float(np.abs(found - means.reshape(samples - 1, vehicles, -1)[..., [0, 1, 4]]).max())
    if not apart < AGREE:
        raise ArithmeticError(f"C in vectors and {NAME} are {apart:g} apart: not the same filter")
    bank, vectors = time_in_turn(
        lambda: bank_of(NAME, fleet).advance(t, signals),
        lambda: make_limit(VectorLimit, drive, vehicles, speed).drive(turned, drive.gone),
    )
    return bank / vectors * (samples - 1) / samples
