"""A fusion as Arrow tables and back, exactly: what a restart or a look at the past can begin from instead of a replay.

The archive decides where the tables lie and which rows of the log are younger (`received_at`); nothing is read or
written here.
"""

from __future__ import annotations

from typing import Any, Final, cast

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from fleet_service.fusion import Fusion
from fleet_service.fusion.image import LAYOUT, fusion_of, image_of
from schemas.errors import InputError

VERSION: Final = f"5-{LAYOUT}"  # what is not this is not read: the archive is replayed
_KEY: Final = b"gripmap.checkpoint"


def tables_of(fusion: Fusion) -> dict[str, pa.Table]:
    """Everything that a fusion holds, one table per name; columns of unequal length (rows of several numbers) are kept
    as one list each."""
    out = {}
    for name, columns in image_of(fusion).items():
        arrays = [_listed(column) for column in columns.values()]
        fields = [pa.field(key, a.type) for key, a in zip(columns, arrays, strict=True)]
        out[name] = pa.Table.from_arrays(arrays, schema=pa.schema(fields, {_KEY: VERSION.encode()}))
    return out


def _listed(column: NDArray[Any]) -> pa.Array[Any]:
    """One list that holds a column."""
    return pa.LargeListArray.from_arrays(pa.array([0, len(column)], pa.int64()), pa.array(column))


def _unlisted(column: pa.ChunkedArray[Any]) -> NDArray[Any]:
    """The column that a list holds; a view, where Arrow's own way to an array looks for another library first."""
    whole = column.chunk(0) if column.num_chunks == 1 else column.combine_chunks()  # which copies what is one piece
    values = cast("pa.LargeListArray[Any]", whole).flatten()
    if pa.types.is_boolean(values.type):
        return np.asarray(values)
    data = np.frombuffer(memoryview(values.buffers()[1] or b""), values.type.to_pandas_dtype())
    return data[values.offset : values.offset + len(values)]


def fusion_from(tables: dict[str, pa.Table], lateness_s: float) -> Fusion:
    """The fusion that was; it goes on as the one that `tables_of` was given would have.

    Raises:
        InputError: tables of another version, or not all of them.
    """
    versions = {(table.schema.metadata or {}).get(_KEY, b"").decode() for table in tables.values()}
    if versions != {VERSION}:
        raise InputError("checkpoint", f"is not of version {VERSION}", "replay the archive instead")
    image = {name: {key: _unlisted(table[key]) for key in table.column_names} for name, table in tables.items()}
    try:
        return fusion_of(image, lateness_s)
    except (KeyError, ValueError) as error:
        raise InputError("checkpoint", f"is not whole ({error})", "replay the archive instead") from error
