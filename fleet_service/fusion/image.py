"""Complete state of a fusion (the beliefs about all cells and the trust in all vehicles) as plain
arrays, for snapshots. A restored fusion continues exactly where the snapshot was taken. Pure (no
I/O).

An `Image` maps table names to tables; a table is a set of one-dimensional columns of equal length.
An array of records is stored as one column of bytes. LAYOUT describes these bytes: name, offset and
byte order of every field.
"""

from __future__ import annotations

import hashlib
from dataclasses import fields
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from fleet_service.fusion.belief import PackedArray
from fleet_service.fusion.fuse import Fusion
from fleet_service.fusion.store.cells import no_beliefs, rows_of_lines
from fleet_service.fusion.store.records import (
    CELL,
    ENTRY,
    FREE_ENTRIES,
    FREE_WINDOWS,
    PAIR,
    PEER,
    REPORTER,
    REPORTERS_USED,
    SETTLED,
    SOURCE,
    VEHICLE,
    WINDOW,
    Rows,
    State,
)
from fleet_service.fusion.store.store import Store
from fleet_service.fusion.vote_weights import VoteWeights
from fleet_service.fusion.weather import Reports
from schemas import mugrid
from schemas.numeric import ByteArray
from schemas.runtime.records import RecordArray

Image = dict[str, dict[str, NDArray[Any]]]
_RECORDS: Final = {
    "cells": CELL,
    "base_cells": CELL,
    "base_sources": SOURCE,
    "windows": WINDOW,
    "entries": ENTRY,
    "pairs": PAIR,
    "settled": SETTLED,
    "reporters": REPORTER,
    "peers": PEER,
    "names": VEHICLE,
}
# Rows of a restored array per stored row, so that the next new cell does not cause another copy.
# Unused rows take no memory.
ROOM: Final = {"cells": 2, "reporters": 2}
LAYOUT: Final = hashlib.blake2b(
    repr([kind.descr for kind in _RECORDS.values()]).encode(), digest_size=8
).hexdigest()


def image_of(fusion: Fusion) -> Image:
    """Return the complete state of a fusion (beliefs about all cells) as plain arrays. Rows keep
    their numbers, because the tables refer to each other by row. Later updates of the fusion also
    change the arrays.
    """
    store = fusion.store
    state = fusion.store.state
    live = state.live
    base = state.base
    records = {
        "cells": live.cells[: store.size],
        "base_cells": base.cells,
        "base_sources": base.reporters,
        "windows": state.windows,
        "entries": state.entries,
        "pairs": state.pairs,
        "settled": state.settled,
        "reporters": live.reporters[: int(state.used[REPORTERS_USED])],
        "peers": store.peers[: store.vehicles],
        "names": store.names[: store.vehicles],
    }
    image: Image = {name: {"bytes": _record_bytes(array)} for name, array in records.items()}
    image["belief"] = {"bins": live.belief[: store.size].reshape(-1)}
    image["base_belief"] = {"bins": base.belief.reshape(-1)}
    image["settled_reports"] = {
        "key": state.settled_keys,
        "std": state.settled_std,
        "begin": state.settled_begin.reshape(-1),
    }
    image["free_windows"] = {"row": state.free_windows[: int(state.used[FREE_WINDOWS])]}
    image["free_entries"] = {"row": state.free_entries[: int(state.used[FREE_ENTRIES])]}
    image["used"] = {
        "count": state.used,
        "more": np.array([store.size, store.vehicles, store.forgotten_at, fusion.epoch]),
    }
    image["trust"] = {
        "epoch": np.concatenate(
            [np.full(len(votes.weight), votes.epoch) for votes in fusion.vote_weights]
        ),
        "weight": np.concatenate([votes.weight for votes in fusion.vote_weights]),
        "heeded": np.concatenate([votes.heeded for votes in fusion.vote_weights]),
    }
    image["trusts"] = {
        "epoch": np.array([votes.epoch for votes in fusion.vote_weights]),
        "vehicles": np.array([len(votes.weight) for votes in fusion.vote_weights]),
        "newcomer": np.array([votes.initial for votes in fusion.vote_weights]),
    }
    reports = fusion.reports
    image["weather"] = {f.name: getattr(reports, f.name).reshape(-1) for f in fields(Reports)}
    return image


def fusion_of(image: Image, lateness_s: float) -> Fusion:
    """Return the fusion that an image (tables of arrays) describes. `lateness_s` [s] must be the
    allowed delay of observations in the fusion from which the image was made.
    """
    fusion = Fusion(lateness_s)
    records = {
        name: _restore_records(image[name]["bytes"], kind, ROOM.get(name, 1))
        for name, kind in _RECORDS.items()
    }
    size, vehicles, forgotten_at, epoch = image["used"]["more"].tolist()
    state = State(
        live=Rows(
            _restore_beliefs(image["belief"]["bins"], ROOM["cells"]),
            records["cells"],
            records["reporters"],
        ),
        base=Rows(
            _restore_beliefs(image["base_belief"]["bins"], 1),
            records["base_cells"],
            records["base_sources"],
        ),
        windows=records["windows"],
        free_windows=_pad_rows(image["free_windows"]["row"], len(records["windows"])),
        entries=records["entries"],
        free_entries=_pad_rows(image["free_entries"]["row"], len(records["entries"])),
        pairs=records["pairs"],
        # Copies own their memory, so that `settle_pairs` can resize them.
        settled=records["settled"].copy(),
        settled_keys=image["settled_reports"]["key"].copy(),
        settled_std=image["settled_reports"]["std"].copy(),
        settled_begin=image["settled_reports"]["begin"].reshape(-1, 2).copy(),
        used=image["used"]["count"].copy(),
    )
    fusion.store = Store.of(state, records["peers"], records["names"], size, vehicles, forgotten_at)
    ends = np.cumsum(image["trusts"]["vehicles"])[:-1]
    weights = np.split(image["trust"]["weight"], ends)
    heeded = np.split(image["trust"]["heeded"].astype(np.bool_), ends)
    epochs = image["trusts"]["epoch"].tolist()
    newcomers = image["trusts"]["newcomer"].tolist()
    vote_weights = [VoteWeights(*of) for of in zip(epochs, weights, newcomers, heeded, strict=True)]
    columns = {f.name: image["weather"][f.name] for f in fields(Reports)}
    columns["prior"] = columns["prior"].reshape(-1, mugrid.BINS)
    fusion.resume(None if epoch < 0 else epoch, vote_weights, Reports(**columns))
    return fusion


def _record_bytes(records: RecordArray) -> ByteArray:
    return records.view(np.uint8) if len(records) else np.zeros(0, np.uint8)


def _restore_records(stored: ByteArray, kind: np.dtype[Any], room: int) -> RecordArray:
    rows = stored.view(kind)
    out = rows_of_lines(room * len(rows), kind)
    out[: len(rows)] = rows
    return out


def _restore_beliefs(bins: PackedArray, room: int) -> PackedArray:
    rows = len(bins) // mugrid.BINS
    out = no_beliefs(room * rows)
    out[:rows] = bins.reshape(rows, mugrid.BINS)
    return out


def _pad_rows(rows: NDArray[Any], places: int) -> NDArray[Any]:
    out = np.zeros(places, np.int32)
    out[: len(rows)] = rows
    return out
