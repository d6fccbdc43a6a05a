"""Lossless conversion of a fusion (the beliefs about the friction of all cells) to Arrow tables and
back, so that a restart needs no complete replay.

The caller stores the tables and decides which archived rows are newer. This module does no I/O.
"""

from __future__ import annotations

from typing import Any, Final, cast

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from fleet_service.fusion import Fusion
from fleet_service.fusion.image import LAYOUT, fusion_of, image_of
from schemas.errors import InputError

# Version of the tables. If a checkpoint has another one, the service replays the archive instead.
VERSION: Final = f"5-{LAYOUT}"
_KEY: Final = b"gripmap.checkpoint"


def tables_of(fusion: Fusion) -> dict[str, pa.Table]:
    """Return the complete state of a fusion as tables by name. Each column is stored as one list,
    because columns may differ in length.
    """
    out = {}
    for name, columns in image_of(fusion).items():
        arrays = [_to_list(column) for column in columns.values()]
        fields = [pa.field(key, a.type) for key, a in zip(columns, arrays, strict=True)]
        out[name] = pa.Table.from_arrays(arrays, schema=pa.schema(fields, {_KEY: VERSION.encode()}))
    return out


def _to_list(column: NDArray[Any]) -> pa.Array[Any]:
    """Return a column of a checkpoint's table (part of a saved state) as an Arrow list array with
    one item: the list of all values.
    """
    return pa.LargeListArray.from_arrays(pa.array([0, len(column)], pa.int64()), pa.array(column))


def _from_list(column: pa.ChunkedArray[Any]) -> NDArray[Any]:
    """Return the values of a list column as a NumPy array. Numbers are not copied. Arrow's own
    conversion is not used, because it would import another library.
    """
    # `combine_chunks` copies the chunks into one piece of memory.
    whole = column.chunk(0) if column.num_chunks == 1 else column.combine_chunks()
    values = cast("pa.LargeListArray[Any]", whole).flatten()
    if pa.types.is_boolean(values.type):
        return np.asarray(values)
    data = np.frombuffer(memoryview(values.buffers()[1] or b""), values.type.to_pandas_dtype())
    return data[values.offset : values.offset + len(values)]


def fusion_from(tables: dict[str, pa.Table], lateness_s: float) -> Fusion:
    """Restore a fusion from its tables. With the same later observations, it gives exactly the same
    results as the fusion that was passed to `tables_of`.

    Raises:
        InputError: the tables are of another version, or incomplete.
    """
    versions = {(table.schema.metadata or {}).get(_KEY, b"").decode() for table in tables.values()}
    if versions != {VERSION}:
        raise InputError("checkpoint", f"is not of version {VERSION}", "replay the archive instead")
    image = {
        name: {key: _from_list(table[key]) for key in table.column_names}
        for name, table in tables.items()
    }
    try:
        return fusion_of(image, lateness_s)
    except (KeyError, ValueError) as error:
        raise InputError(
            "checkpoint", f"is incomplete ({error})", "replay the archive instead"
        ) from error
