"""Example of your own estimator: it reports only that friction is at least the grip in use.

To make it a plug-in, add this to the pyproject.toml of your package:

    [project.entry-points."gripmap.estimators"]
    at-least = "my_package:AtLeast"

Then `edge-agent replay --estimator at-least`, `edge-agent run` and `make_bank` can use it. This
example uses it directly:

python deploy/examples/own_estimator.py
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

import edge_agent
from edge_agent.estimators.estimates import ONE_FRICTION, Column
from schemas.signals import S
from schemas.thresholds import GRAVITY

# 5 %, 50 % and 95 % quantiles of the friction before anything is measured.
PRIOR = (0.11, 0.63, 1.14)
PRIOR_SLIPPERY = 0.3  # P(mu < 0.4) of the same prior


class AtLeast:
    """Estimator of friction for N vehicles. Its only state is the largest grip that each vehicle
    has used so far.

    Args:
        vehicles: nominal parameters of the N vehicles.
    """

    def __init__(self, vehicles: Sequence[edge_agent.Vehicle]) -> None:
        self._used = np.zeros(len(vehicles))
        self._radius = np.array([vehicle.wheel_radius for vehicle in vehicles])

    def advance(
        self,
        t: np.ndarray[Any, Any],
        signals: np.ndarray[Any, Any],
        closes: object = None,
        *,
        threads: int = 1,
    ) -> edge_agent.Estimates:
        """Return estimates for samples of N vehicles: times t (T, N) [s], and signals (T, N, 18) in
        the order of schemas.signals.CHANNELS, with NaN where a sensor value is missing.
        """
        del closes, threads  # this estimator ignores the ends of visits and uses one thread
        values = np.zeros((*t.shape, ONE_FRICTION))
        pull = np.nan_to_num(np.hypot(signals[..., S.AX], signals[..., S.AY])) / GRAVITY
        used = np.maximum.accumulate(np.concatenate([self._used[None], pull]), axis=0)[1:]
        self._used = used[-1]
        values[..., Column.VX] = np.nan_to_num(
            np.nanmean(signals[..., S.OMEGA : S.OMEGA + 4], axis=-1) * self._radius
        )
        values[..., Column.YAW_RATE] = np.nan_to_num(signals[..., S.YAW_RATE])
        values[..., Column.VX_STD : Column.SIDESLIP_STD + 1] = 1.0
        values[..., Column.MU_UTILISED] = used
        values[..., Column.P_SLIPPERY] = PRIOR_SLIPPERY
        for column, prior in zip((Column.MU_LOWER, Column.MU, Column.MU_UPPER), PRIOR, strict=True):
            values[..., column] = np.maximum(prior, used)
        return edge_agent.Estimates(values)


def main() -> None:
    """Run the example's estimator on a simulated drive and print its estimates."""
    log, vehicle = edge_agent.simulate_manoeuvre("double-lane-change", mu=0.5, seed=1)
    signals = np.stack([log[name].to_numpy() for name in edge_agent.CHANNELS], axis=-1)[:, None]
    t = log["t"].to_numpy()[:, None]
    found = edge_agent.to_table(t, AtLeast([vehicle]).advance(t, signals))
    print(found.select(["t", "mu_lower", "mu", "mu_upper"]).slice(600, 1).to_pylist())


if __name__ == "__main__":
    main()
