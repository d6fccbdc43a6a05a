"""What a service knows of its archive: from the newest checkpoint and the log after it, or from the log alone."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import pyarrow as pa

from fleet_service.archive.layout import Cut
from fleet_service.archive.load import pass_over
from fleet_service.fusion import Fusion
from fleet_service.fusion.weather import Reports
from fleet_service.ingest.dedup import SequenceTrackers
from fleet_service.ingest.weather import archived
from fleet_service.replay.checkpoints import Taken
from fleet_service.replay.rebuild import Begin, Since, first_day, replay, restore_streams
from fleet_service.replay.restart import image_of, restart
from fleet_service.serve.alerts import Alerts
from fleet_service.serve.map_state import MapState

SLOTS: Final = 20_000  # at once: a lock is held for 40 ms, and little memory is needed


class Memory(NamedTuple):
    """What is known.

    Attributes:
        fusion, map, alerts: of all observations.
        streams: batches that were admitted.
        weather: all reports that were used.
        refused: checkpoints that could not be begun from.
    """

    fusion: Fusion
    map: MapState
    alerts: Alerts
    streams: SequenceTrackers
    weather: Reports
    refused: int

    def image(self, cut: Cut, weather: Iterable[Path]) -> Taken:
        """What a checkpoint keeps of it; everything up to the segment `cut`, and these files of weather, are in it."""
        tables = image_of(self.fusion, self.alerts.standing, self.streams)
        return Taken(tables, cut, tuple(path.name for path in weather))


def remember(
    root: Path, lateness_s: float, damaged: Callable[[Path, str], None] = pass_over, until: Cut | None = None
) -> Memory:
    """Read the archive; of segments that are not compacted, those written up to `until`.

    Raises:
        OSError: it cannot be read.
    """
    begin = restart(root, lateness_s)
    fusion, streams = begin.fusion, begin.streams
    shown, alerts = MapState(fusion), Alerts(fusion)
    alerts.resume(begin.standing)
    used = archived(root, damaged=damaged)  # before the observations, which it acts on
    fusion.update_weather(archived(root, known=begin.weather, damaged=damaged) if begin.cut else used)
    restored = np.array_split(np.arange(fusion.size), fusion.size // SLOTS + 1)
    matters = Begin(first_day(root), begin.cut, until)
    rest = replay(root, fusion, Since(matters, streams if begin.cut else None), damaged)
    with ThreadPoolExecutor(1, "streams") as beside:
        noted = partial(restore_streams, root, streams, matters, damaged)
        noting = None if begin.cut else beside.submit(noted)  # what a checkpoint knows, the replay asks
        for slots in chain(restored, (updated.slots for updated in rest)):
            alerts.updated(slots)
            shown.changed(slots)
        if noting is None:
            noted()
        else:
            noting.result()
    pa.default_memory_pool().release_unused()  # the archive went through it
    return Memory(fusion, shown, alerts, streams, used, begin.refused)
