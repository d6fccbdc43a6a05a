"""Writer of estimates in the format MCAP, for Foxglove and other viewers: JSON messages with a
schema, one per sample, on one topic.
"""

from __future__ import annotations

import json
import math
from typing import BinaryIO, Final, Self

import pyarrow as pa

from schemas.errors import InputError
from schemas.runtime.installing import install_command
from schemas.thresholds import NS

TOPIC: Final = "/gripmap/estimates"
_JSON: Final = {"double": "number", "int32": "integer"}


class McapTableWriter:
    """Writer of tables of estimates to an MCAP file. The file's log times count from the first
    sample of the drive.

    A value that is NaN or null is left out of its message, because JSON cannot represent NaN.

    Args:
        file: file opened for writing.
        schema: schema of the tables; its column `t` is the time [s].

    Raises:
        InputError: the package mcap is missing.
    """

    def __init__(self, file: BinaryIO, schema: pa.Schema) -> None:
        try:
            from mcap.writer import Writer
        except ImportError as error:
            raise InputError(
                "out", "the package mcap is missing", install_command("mcap")
            ) from error
        self._writer = Writer(file)
        self._count = 0
        self._writer.start(library="gripmap")
        fields = {field.name: {"type": _JSON[str(field.type)]} for field in schema}
        described = json.dumps(
            {"type": "object", "title": "gripmap.Estimates", "properties": fields}
        )
        known = self._writer.register_schema("gripmap.Estimates", "jsonschema", described.encode())
        self._channel = self._writer.register_channel(TOPIC, "json", known)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.finish()  # type: ignore[no-untyped-call]

    def write_table(self, table: pa.Table) -> None:
        """Write each row of a table of estimates as one JSON message of the MCAP file."""
        for row in table.to_pylist():
            values = {
                name: value
                for name, value in row.items()
                if value is not None and math.isfinite(value)
            }
            at = max(round(row["t"] * NS), 0)
            self._writer.add_message(
                self._channel, at, json.dumps(values).encode(), at, self._count
            )
            self._count += 1
