"""Benchmark of an estimator: time per vehicle and sample."""

from __future__ import annotations

import numpy as np

from edge_agent.app.estimator_factory import bank_of
from edge_agent.lab.simulation import simulate_manoeuvre
from schemas.numeric import FloatArray
from schemas.runtime.figures import Figure
from schemas.signals import CHANNELS
from tests.benchmarks.measure import ROUNDS, SEED, median_s


def estimators() -> list[Figure]:
    """Measure the time [µs] per vehicle and sample of the default estimator, for one vehicle and
    for a bank.
    """
    log, vehicle = simulate_manoeuvre("double-lane-change", seed=SEED)
    signals = np.stack([log[name].to_numpy(zero_copy_only=False) for name in CHANNELS], axis=-1)[
        :, None, :
    ]
    t: FloatArray = log["t"].to_numpy()[:, None]

    def run_estimator(n: int, samples: int) -> float:
        block = np.repeat(signals[:samples], n, axis=1)
        times = np.repeat(t[:samples], n, axis=1)
        banks = [
            bank_of("aco-fckf", [vehicle] * n) for _ in range(ROUNDS + 1)
        ]  # to make one is not to step it
        seconds = median_s(lambda: banks.pop().advance(times, block))
        return seconds / (n * samples) * 1e6

    one = run_estimator(1, len(t))
    many = run_estimator(200, 100)
    return [
        Figure("bench.aco_fckf.us", one, "us per vehicle-step of the default, N = 1", 25),
        Figure("bench.aco_fckf.flatness", many / one, "N = 200 over N = 1", 1.2),
        Figure("bench.replay.real_time", 1e6 / (100 * one), "times real time at 100 Hz"),
    ]
