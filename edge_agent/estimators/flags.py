"""Health flags as plain integers, because compiled functions cannot combine members of an
enumeration.
"""

from __future__ import annotations

from typing import Final

from schemas.signals import Health

OK: Final = int(Health.OK)
NO_TORQUE: Final = int(Health.NO_TORQUE)
NO_WHEEL_SPEED: Final = int(Health.NO_WHEEL_SPEED)
NO_INERTIAL: Final = int(Health.NO_INERTIAL)
NO_STEERING: Final = int(Health.NO_STEERING)
NO_POSITION: Final = int(Health.NO_POSITION)
TIME_GAP: Final = int(Health.TIME_GAP)
OUTLIER: Final = int(Health.OUTLIER)
SLIDING: Final = int(Health.SLIDING)
RESET: Final = int(Health.RESET)
CONTRADICTION: Final = int(Health.CONTRADICTION)
