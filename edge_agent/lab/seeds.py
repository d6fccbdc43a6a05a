"""Ranges of random seeds: tuning and evaluation use different seeds.

All constants, memberships and rules are chosen with seeds below FIGURES. Every published figure
comes from seeds of at least FIGURES, so the noise, vehicle files, sensor errors, roads and towns
differ from those used for tuning.
"""

from typing import Final

FIGURES: Final = 20_000
