"""Fusion: one belief per cell and sector on the friction grid. Pure: no clocks, no files, no
network.
"""

from __future__ import annotations

from fleet_service.fusion.fuse import Fusion, Updated
from fleet_service.fusion.observations import Observations, observations_of

__all__ = ["Fusion", "Observations", "Updated", "observations_of"]
