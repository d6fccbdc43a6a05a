"""Fusion: the reports of many vehicles become one belief (probability distribution of friction) per
map cell and heading sector. The package is pure: it uses no clock, file or network.
"""

from __future__ import annotations

from fleet_service.fusion.fuse import Fusion, Updated
from fleet_service.fusion.observations import Observations, observations_of

__all__ = ["Fusion", "Observations", "Updated", "observations_of"]
