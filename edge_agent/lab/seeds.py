"""Ranges of random seeds: tuning and evaluation use different seeds.

All constants, memberships and rules are chosen with seeds below FIGURES. Every published figure
comes from seeds of at least FIGURES, which give other noise, vehicle files, misaligned sensors,
roads and towns.
"""

from typing import Final

FIGURES: Final = 20_000
