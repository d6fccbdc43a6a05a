"""Fusion: one belief per cell and sector on the friction grid. Pure: no clocks, no files, no network."""

from __future__ import annotations

from fleet_service.fusion.fuse import Folded, Fusion, Observations
from fleet_service.fusion.likelihoods import evidence

__all__ = ["Folded", "Fusion", "Observations", "evidence"]
