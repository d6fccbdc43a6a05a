"""Fusion: the fleet's reports become one belief (probability distribution of friction) per cell and
sector of the friction grid. The package is pure: it uses no clock, file or network.
"""

from __future__ import annotations

from fleet_service.fusion.fuse import Fusion, Updated
from fleet_service.fusion.observations import Observations, observations_of

__all__ = ["Fusion", "Observations", "Updated", "observations_of"]
