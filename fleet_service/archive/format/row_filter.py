"""Row filter: a range of values per column. It can be evaluated on a file's statistics before any
row is read.

Ranges are used instead of Arrow's expressions for two reasons. Expressions import pandas (40 MB per
process), and their scan holds several complete row groups in memory.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

Bound = int | float | str | None


class ValueRange(NamedTuple):
    """Filter for rows whose value lies from `least` to `most`, both included; None means no limit.
    Times are in whole microseconds. A row without a value does not match.
    """

    column: str
    least: Bound = None
    most: Bound = None


Where = Sequence[ValueRange]


def filter_table(table: pa.Table, where: Where) -> pa.Table:
    """Return the rows of a table that match all value ranges in `where`, with all columns."""
    for column, least, most in where:
        values = table[column]
        if pa.types.is_timestamp(values.type):
            values = values.cast(pa.int64())
        for compare, bound in ((pc.greater_equal, least), (pc.less_equal, most)):
            if bound is not None:
                mask = compare(values, pa.scalar(bound, values.type))
                table = table.filter(mask)
                values = values.filter(mask)
    return table


def matching_row_groups(footer: pq.FileMetaData, where: Where) -> list[int]:
    """Return the indices of a Parquet file's row groups (parts) that may contain rows that match
    the filter `where`, according to the statistics in the file's footer.
    """
    places = {footer.schema.column(at).path: at for at in range(footer.num_columns)}
    known = [(places[one.column], one) for one in where if one.column in places]
    return [
        group
        for group in range(footer.num_row_groups)
        if all(_may_match(footer.row_group(group).column(at).statistics, one) for at, one in known)
    ]


def _may_match(statistics: Any, limits: ValueRange) -> bool:  # noqa: ANN401 pyarrow has no type
    if statistics is None or not statistics.has_min_max:
        return True
    least, most = (bound.encode() if isinstance(bound, str) else bound for bound in limits[1:])
    return (most is None or statistics.min_raw <= most) and (
        least is None or statistics.max_raw >= least
    )
