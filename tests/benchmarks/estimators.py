"""Benchmark of the default estimator: time per vehicle and sample, and share of the processor's
floating-point peak.
"""

from __future__ import annotations

import numpy as np

from edge_agent.app.estimator_factory import bank_of
from edge_agent.lab.simulation import simulate_manoeuvre
from schemas.numeric import FloatArray
from schemas.runtime.figures import Figure
from schemas.signals import CHANNELS
from tests.benchmarks.measure import ROUNDS, SEED, median_s
from tests.benchmarks.peak import count_operations, measure_peak


def estimators() -> list[Figure]:
    """Measure the time [µs] per vehicle and sample of the default estimator, for one vehicle and
    for an estimator bank (many vehicles computed together).
    """
    log, vehicle = simulate_manoeuvre("double-lane-change", seed=SEED)
    signals = np.stack([log[name].to_numpy(zero_copy_only=False) for name in CHANNELS], axis=-1)[
        :, None, :
    ]
    t: FloatArray = log["t"].to_numpy()[:, None]

    def run_estimator(n: int, samples: int) -> float:
        block = np.repeat(signals[:samples], n, axis=1)
        times = np.repeat(t[:samples], n, axis=1)
        # The estimators are created in advance, so that only their steps are timed.
        banks = [bank_of("aco-fckf", [vehicle] * n) for _ in range(ROUNDS + 1)]
        seconds = median_s(lambda: banks.pop().advance(times, block))
        return seconds / (n * samples) * 1e6

    peak = measure_peak()
    one = run_estimator(1, len(t))
    gflops = count_operations(float(t[1, 0] - t[0, 0])) / one / 1e3
    many = run_estimator(200, 100)
    return [
        Figure("bench.aco_fckf.us", one, "us per vehicle-step of the default, N = 1", 8),
        Figure("bench.aco_fckf.flatness", many / one, "N = 200 over N = 1", 1.2),
        Figure("bench.peak", peak, "GFLOP/s, double-precision multiply-adds of one core"),
        Figure(
            "bench.aco_fckf.peak_share",
            gflops / peak,
            "of bench.peak, by operations counted from the source",
            0.25,
            "more",
        ),
        Figure("bench.replay.real_time", 1e6 / (100 * one), "times real time at 100 Hz"),
    ]
