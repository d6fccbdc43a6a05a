"""The ice that appears on the road during the demo: where and when, according to the scenario."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import pyarrow as pa

from edge_agent.lab.simulation.scenarios import Scenario
from schemas import grid
from schemas.numeric import BoolArray, IntArray
from schemas.thresholds import NS, SLIPPERY_MU

SAMPLED_M: Final = 0.5  # [m] distance of the points at which a patch of ice is sampled


@dataclass(frozen=True)
class NewIce:
    """Ice that appears on the road during the demo: the time `since_ns` [ns] at which it appears,
    and the map cells that it touches.
    """

    since_ns: int
    cells: IntArray

    def find_visits(self, visits: pa.Table) -> BoolArray:
        """Return a mask of the visits (passages of a map cell), (visits,): True for visits to the
        new ice after it appeared.

        Visits to snow and ice that were there from the start do not count, even if no vehicle drove
        there before the new ice appeared.
        """
        enter = visits["enter_time"].cast(pa.int64()).to_numpy()
        in_cells = np.isin(visits["cell"].to_numpy(), self.cells)
        return np.asarray(
            in_cells & (enter >= self.since_ns) & (visits["mu"].to_numpy() < SLIPPERY_MU)
        )


def new_ice(scenario: Scenario, start_ns: int) -> NewIce:
    """Return the ice that appears in a scenario whose drive begins at `start_ns` [ns].

    Each patch that appears is sampled at a grid of points. A cell counts if the road was not
    slippery at one of its points and is slippery after the patch appeared.
    """
    first_s = scenario.events[0].start
    cells = [np.zeros(0, np.int64)]
    for patch in scenario.events:
        along, across = np.meshgrid(
            np.arange(-patch.length / 2, patch.length / 2, SAMPLED_M),
            np.arange(-patch.width / 2, patch.width / 2, SAMPLED_M),
        )
        x = (patch.x + along * np.cos(patch.angle) - across * np.sin(patch.angle)).ravel()
        y = (patch.y + along * np.sin(patch.angle) + across * np.cos(patch.angle)).ravel()
        appeared = (scenario.friction(first_s - 1.0, x, y) >= SLIPPERY_MU) & (
            scenario.friction(patch.start, x, y) < SLIPPERY_MU
        )
        cells.append(grid.cell_of(*scenario.to_latlon(x[appeared], y[appeared])))
    return NewIce(start_ns + int(first_s * NS), np.unique(np.concatenate(cells)))
