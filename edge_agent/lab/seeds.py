"""Ranges of random seeds: tuning and evaluation use separate seeds.

Everything that is chosen (constants, memberships, rules) is chosen on seeds below FIGURES, and
every figure that is published comes from seeds from FIGURES on: other noise, vehicle files,
misaligned devices, roads and towns.
"""

from typing import Final

FIGURES: Final = 20_000
