"""Whose seeds are whose: nobody judges with what was tuned on.

Everything that is chosen (constants, memberships, rules) is chosen on seeds below FIGURES, and
every figure that is published comes from seeds from FIGURES on: other noise, vehicle files,
misaligned devices, roads and towns.
"""

from typing import Final

FIGURES: Final = 20_000
