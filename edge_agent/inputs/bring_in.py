"""Import of recordings into a signal log: choose the reader of each file, apply the profile
(assignment of signals to channels), and write a Parquet file whose metadata records its origin.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from edge_agent.inputs.memory import bounded_memory
from edge_agent.inputs.merge import Merged
from edge_agent.inputs.profile import Channel, Profile
from edge_agent.inputs.readers import can_log, can_text, gnss, mdf, racelogic, rosbag, tabular
from edge_agent.inputs.readers.dbc import Database
from edge_agent.inputs.recording import Recording, foreign_errors
from schemas.errors import InputError
from schemas.signals import CHANNELS, CONTEXT
from schemas.thresholds import NS

RLOGS = ("rlog", "qlog")
PROVENANCE = b"gripmap.import"


def read_source(path: Path, profile: Profile | None, database: Database | None) -> Recording:
    """Read a recording of any supported file format.

    Return the signals that the profile needs, or all signals if `profile` is None. `database` is
    the CAN database that decodes logs of CAN frames.

    Raises:
        InputError: the file is missing, of an unknown kind, broken or too large for the memory, or
            it needs a CAN database or a library that is missing.
    """
    with bounded_memory(path):
        return _read_source(path, profile, database)


def _read_source(path: Path, profile: Profile | None, database: Database | None) -> Recording:
    wanted = None if profile is None else profile.needed_signals()
    suffix = path.suffix.lower()
    if not path.exists():
        raise InputError("source", f"{path} does not exist", "give the path of a recording")
    if not path.is_file() and not path.is_dir():  # a pipe, for example, may never end
        raise InputError("source", f"{path} is not a file", "write the recording to a file first")
    if rosbag.is_bag(path):
        with rosbag.open_bag(path) as reader:
            if rosbag.has_frames(reader):
                return _decode_frames(
                    lambda ids: rosbag.bag_frames(reader, path, ids), path, profile, database
                )
            return rosbag.read_bag(reader, path, wanted)
    if suffix in mdf.SUFFIXES:
        identifiers = (
            None if database is None else {message.identifier for message in database.values()}
        )
        content = mdf.read_isolated(path, identifiers, wanted)
        if content.recording is not None:
            return content.recording
        return _decode_frames(lambda _: content.frames or ({}, 0.0), path, profile, database)
    if path.name.lower().startswith(RLOGS):
        fix = "export CAN frames (candump) or a CSV with openpilot's LogReader"
        raise InputError(
            "source", f"{path} is an openpilot log, which this command cannot read", fix
        )
    if suffix == ".trc" and can_text.is_bare_trace(path):
        return _decode_frames(lambda ids: can_text.trace_frames(path, ids), path, profile, database)
    if suffix in can_log.SUFFIXES:
        return _decode_frames(lambda ids: can_log.log_frames(path, ids), path, profile, database)
    if suffix in gnss.SUFFIXES:
        return gnss.read_gnss(path)
    if suffix in racelogic.SUFFIXES:
        return racelogic.read_vbo(path)
    if suffix in tabular.SUFFIXES:
        if suffix != ".parquet" and racelogic.is_vbo(path):
            return racelogic.read_vbo(path)
        if suffix == ".csv" and can_text.is_gvret(path):
            return _decode_frames(
                lambda ids: can_text.gvret_frames(path, ids), path, profile, database
            )
        time, unit = (profile.time, profile.time_unit) if profile else (None, None)
        return tabular.read_table(path, time, unit)
    known = sorted(
        {
            *can_log.SUFFIXES,
            *gnss.SUFFIXES,
            *mdf.SUFFIXES,
            *racelogic.SUFFIXES,
            *rosbag.SUFFIXES,
            *tabular.SUFFIXES,
        }
    )
    raise InputError(
        "source",
        f"{path} has an unknown format",
        f"give one of {' '.join(known)}, or a bag's folder",
    )


def _decode_frames(
    frames: can_log.Taker, path: Path, profile: Profile | None, database: Database | None
) -> Recording:
    if database is None:
        raise can_log.no_database(path)
    every = {
        f"{message.name}.{signal}" for message in database.values() for signal in message.signals
    }
    wanted = every if profile is None else profile.needed_signals()
    buses = (
        {c.message: c.bus for c in profile.channels.values() if c.message and c.bus is not None}
        if profile
        else {}
    )
    with foreign_errors(path, "CAN log"):
        return can_log.decode_log(frames, path.name, database, wanted, buses)


def profile_of(log: Path) -> Profile:
    """Return the profile with which a log was imported. If the log was not imported, return a
    profile that uses its columns unchanged.

    Raises:
        InputError: the file cannot be read.
    """
    with foreign_errors(log, "Parquet"):
        schema = pq.ParquetFile(log).schema_arrow
        if (provenance := (schema.metadata or {}).get(PROVENANCE)) is not None:
            return Profile.model_validate(json.loads(provenance)["profile"])
        return Profile(
            name=log.stem[:64],
            channels={n: Channel(signal=n) for n in (*CHANNELS, *CONTEXT) if n in schema.names},
        )


def write_log(path: Path, merged: Merged, profile: Profile, sources: Sequence[str]) -> None:
    """Write a merged signal log to a Parquet file.

    The time column is `timestamp` if the date of the recording is known, else `t`. The file's
    metadata records the source files, the profile and the processing steps.
    """
    columns: dict[str, Any] = {}
    if merged.start_ns is not None:
        whole = merged.start_ns + np.rint(merged.t * NS).astype(np.int64)
        columns["timestamp"] = pa.array(whole, pa.int64()).cast(pa.timestamp("ns", tz="UTC"))
    else:
        # Round to nanoseconds, as in logs with a date, so that the same drive gives the same log
        # from every format.
        columns["t"] = pa.array(np.rint(merged.t * NS) / NS)
    columns |= {name: pa.array(values, from_pandas=True) for name, values in merged.columns.items()}
    provenance: Mapping[str, object] = {
        "profile": json.loads(profile.to_json()),
        "sources": list(sources),
        "channels": merged.origins,
        "notes": merged.notes,
    }
    table = pa.table(columns).replace_schema_metadata({PROVENANCE: json.dumps(provenance).encode()})
    try:
        pq.write_table(table, path, compression="zstd")
    except OSError as error:
        raise InputError(
            "out", f"cannot write {path} ({error})", "name a file in a writable folder"
        ) from error
