"""Signals as a calibrated vehicle means them: offsets off, wheels alike, steering by its true map."""

from __future__ import annotations

from schemas.numeric import FloatArray
from schemas.signals import WHEELS, S
from schemas.vehicle import Vehicle


def corrected(signals: FloatArray, vehicle: Vehicle) -> FloatArray:
    """Signals (…, 18) less what the vehicle's calibration knows of their errors; the same array where there is none.

    What was not learned is taken as sound; what was is a posterior mean, drawn to it. Rear steering stays.
    So does a_y: what it reads straight on is crossfall too, which tyres truly hold, and no drive tells them apart.
    """
    known = vehicle.calibration
    if known is None:
        return signals
    signals = signals.copy()
    for channel, estimate in ((S.AX, known.ax), (S.YAW_RATE, known.yaw_rate)):
        signals[..., channel] -= _value(estimate, 0.0)
    for i, wheel in enumerate(WHEELS):
        signals[..., S.OMEGA + i] /= 1.0 + _value(getattr(known, f"radius_{wheel}"), 0.0)
    signals[..., S.TORQUE : S.TORQUE + 4] /= _value(known.force_gain, 1.0)
    front = slice(S.DELTA, S.DELTA + 2)
    signals[..., front] -= _value(known.steer_offset, 0.0)
    signals[..., front] /= _value(known.steer_gain, 1.0)
    return signals


def _value(estimate: tuple[float, float] | None, sound: float) -> float:
    return sound if estimate is None else estimate[0]
