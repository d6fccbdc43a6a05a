"""Context signals: flags of controllers (ABS, ESC, traction control), air temperature and wiper.
This module converts them from readings of a source to rows (samples) of a log.

Flags and temperatures are not interpolated. A row contains the last reading at or before its time,
if that reading is at most HELD_S old. Some channels are sent only when they change; the profile
(assignment of signals to channels) marks them as `lasting`. The last reading of such a channel is
valid until the next one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from edge_agent.inputs.profile import Profile
from edge_agent.inputs.recording import Series
from schemas.numeric import BoolArray, FloatArray
from schemas.signals import CONTEXT, FLAGS

# [s] age up to which a reading is valid. A controller's flag is sent at 10 to 100 Hz and lasts as
# long as the intervention. Air temperature and wiper change slowly and are sent once or twice a
# second.
HELD_S: Final = {name: 1.0 if name in FLAGS else 30.0 for name in CONTEXT}
# [degC] range of air temperatures on roads. Values outside are codes for "no value", or come from
# broken sensors.
AIR_C: Final = (
    -60.0,
    65.0,
)


def context_values(name: str, values: FloatArray, active: Sequence[float] | None) -> FloatArray:
    """Return the readings of a context signal in the form that the signal log stores: same shape
    and unit, but flags as 0 or 1, and impossible values limited or removed.

    Args:
        name: name of the signal, one of CONTEXT.
        values: readings in the unit of the signal log; NaN for a missing reading.
        active: recorded values at which a flag is on; None means all except 0.

    Returns:
        Flags as 0 or 1, wiper limited to the range 0 to 1, temperatures unchanged. Impossible
        temperatures become NaN; NaN stays NaN.
    """
    if name in FLAGS:
        on = values != 0.0 if active is None else np.isin(values, active)
        return np.where(np.isfinite(values), on.astype(np.float64), np.nan)
    if name == "wiper":
        return np.clip(values, 0.0, 1.0)
    return np.where((values >= AIR_C[0]) & (values <= AIR_C[1]), values, np.nan)


def held_readings(name: str, series: Series, t: FloatArray, *, lasting: bool) -> FloatArray:
    """Return the last reading of a context signal at or before each time t (T,) [s]. It is NaN if
    there is no such reading or if the reading is older than HELD_S.

    A reading of a `lasting` channel (sent only when it changes) never becomes too old. `name` is
    the signal, and `series` its readings.
    """
    known = np.isfinite(series.values)
    times = series.t[known]
    if not len(times):
        return np.full(len(t), np.nan)
    place = np.searchsorted(times, t + 1e-9, side="right") - 1
    last = np.maximum(place, 0)
    fresh = (place >= 0) & (lasting | (t - times[last] <= HELD_S[name]))
    return np.where(fresh, series.values[known][last], np.nan)


def lasting_signals(profile: Profile) -> set[str]:
    """Return the full names of the recorded signals of the `lasting` channels of a profile. The
    signals of such a channel are sent only when they change.
    """
    return {
        name
        for channel in profile.channels.values()
        if channel.lasting
        for name in channel.needed_signals()
    }


def context_signals(profile: Profile) -> set[str]:
    """Return the full names of the recorded signals from which a profile computes the context
    channels (controller flags, temperature, wiper).
    """
    return {
        name
        for channel in CONTEXT
        if channel in profile.channels
        for name in profile.channels[channel].needed_signals()
    }


def context_block(
    samples: int, vehicles: int, values: Mapping[str, FloatArray | BoolArray | float]
) -> FloatArray:
    """Return the context signals of a block, (T, N, len(CONTEXT)), from the values that a source
    gives.

    Signals without a value are NaN (unknown). The function is for sources without a profile
    (assignment of recorded signals to channels), for example a simulation:

        values = {"abs_active": truth.abs, "air_temperature": -3.0}
        Block(t, time, signals, context_block(*t.shape, values))

    Args:
        samples: number T of samples.
        vehicles: number N of vehicles.
        values: values by signal name (from CONTEXT), each of shape (T, N) or (N,), or one number.
            Flags may be boolean; NaN is unknown.

    Raises:
        KeyError: a name is not one of CONTEXT.
        ValueError: a shape does not fit.
    """
    if unknown := values.keys() - set(CONTEXT):
        raise KeyError(f"{sorted(unknown)[0]} is not a context signal; use {', '.join(CONTEXT)}")
    block = np.full((samples, vehicles, len(CONTEXT)), np.nan)
    for name, value in values.items():
        block[..., CONTEXT.index(name)] = context_values(
            name, np.asarray(value, dtype=np.float64), None
        )
    return block
