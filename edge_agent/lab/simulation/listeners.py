"""Simulated drivers who receive warnings and slow down. The module stores the routes ahead of these
drivers, and passes warnings to the drivers.
"""

from __future__ import annotations

import queue
from collections.abc import Iterator
from typing import Final

import numpy as np

from edge_agent.ahead.path import GivenRoute
from edge_agent.inputs.block import Block
from edge_agent.lab.simulation.fleet import GOLDEN, SimulatedFleet
from schemas.errors import InputError
from schemas.numeric import BoolArray
from schemas.wire.ahead import GripWarning

ROUTE_M: Final = 600.0
# [m] distance before and after the stretch in which a driver is also careful. An alert concerns one
# cell, but ice often extends beyond it.
AROUND_M: Final = 25.0
EVERY: Final = 10  # blocks between two updates of the route


def choose_warned(vehicles: int, share: float) -> BoolArray:
    """Return an array (N,) that is True for drivers who receive warnings. They are evenly
    distributed over vehicles with small and with large sensor errors.

    Raises:
        InputError: the share is not between 0 and 1.
    """
    if not 0.0 <= share <= 1.0:
        raise InputError("warned", f"{share} is not a share", "give a number from 0 to 1")
    return np.asarray((np.arange(vehicles) + 0.5) * GOLDEN % 1.0 < share)


class WarnedDrivers:
    """The drivers of a fleet who are warned.

    Args:
        fleet: the simulated vehicles.
        share: share of the drivers who are warned, from 0 to 1; the choice whether the driver of
            vehicle k is warned does not depend on the number of vehicles.

    Raises:
        InputError: the share is not between 0 and 1.
    """

    def __init__(self, fleet: SimulatedFleet, share: float) -> None:
        self._fleet = fleet
        self.warned = choose_warned(len(fleet.names), share)
        self._number = {name: k for k, name in enumerate(fleet.names)}
        self._routes: dict[int, GivenRoute] = {}
        self._warnings: queue.SimpleQueue[tuple[int, GripWarning]] = queue.SimpleQueue()

    def is_warned(self, k: int) -> bool:
        """Return True if the driver of vehicle k receives warnings."""
        return bool(self.warned[k])

    def route_of(self, k: int) -> GivenRoute | None:
        """Return the route ahead of vehicle k; None if no route has been stored yet."""
        return self._routes.get(k)

    def store_warning(self, name: str, warning: GripWarning) -> None:
        """Store a warning for the driver of the vehicle called `name`. The driver gets the warning
        with the next block of samples; the driver's reaction time starts then.

        The method may be called from any thread.
        """
        self._warnings.put((self._number[name], warning))

    def pass_warnings(self, blocks: Iterator[Block]) -> Iterator[Block]:
        """Yield the blocks of samples of a source unchanged, and pass the stored warnings to the
        simulated drivers after each block.
        """
        for number, block in enumerate(blocks):
            if number % EVERY == 0:
                self.update_routes()
            yield block
            self.deliver_warnings()

    def update_routes(self) -> None:
        """Update the stored routes ahead of the drivers who receive warnings."""
        for k in self.warned.nonzero()[0].tolist():
            self._routes[k] = GivenRoute(*self._fleet.route_ahead(k, ROUTE_M))

    def deliver_warnings(self) -> None:
        """Pass the stored warnings to the simulated drivers who receive them."""
        while not self._warnings.empty():
            k, warning = self._warnings.get()
            if warning.state != "ended":  # the driver knows without a message that a stretch ended
                start = warning.distance_m - AROUND_M
                end = warning.distance_m + warning.length_m + AROUND_M
                self._fleet.warn(k, (start, end), warning.safe_speed, warning.mu_lower)
