"""Import of recordings into a signal log: choose the reader of each file, apply the profile
(assignment of signals to channels), and write a Parquet file whose metadata records its origin.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import partial
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
from schemas.runtime.durable import open_durably
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
    _require_readable(path)
    suffix = path.suffix.lower()
    if rosbag.is_bag(path):
        return _read_bag(path, profile, database)
    if suffix in mdf.SUFFIXES:
        return _read_mdf(path, profile, database)
    if path.name.lower().startswith(RLOGS):
        raise InputError(
            "source",
            f"{path} is an openpilot log, which this command cannot read",
            "export CAN frames (candump) or a CSV with openpilot's LogReader",
        )
    if suffix in gnss.SUFFIXES:
        return gnss.read_gnss(path)
    if _is_vbo(path):
        return racelogic.read_vbo(path)
    take_frames = _frame_reader(path)
    if take_frames is not None:
        return _decode_frames(take_frames, path, profile, database)
    if suffix in tabular.SUFFIXES:
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


def _require_readable(path: Path) -> None:
    """Raise an InputError if a path does not exist, or is neither a file nor a folder."""
    if not path.exists():
        raise InputError("source", f"{path} does not exist", "give the path of a recording")
    if not path.is_file() and not path.is_dir():  # a pipe, for example, may never end
        raise InputError("source", f"{path} is not a file", "write the recording to a file first")


def _is_vbo(path: Path) -> bool:
    """Return True for a VBO file, also if it has the suffix of a text table."""
    suffix = path.suffix.lower()
    may_be_text = suffix in tabular.SUFFIXES and suffix != ".parquet"
    return suffix in racelogic.SUFFIXES or (may_be_text and racelogic.is_vbo(path))


def _frame_reader(path: Path) -> can_log.Taker | None:
    """Return the function that reads the CAN frames of a log; None if the file has no frames."""
    suffix = path.suffix.lower()
    if suffix == ".trc" and can_text.is_bare_trace(path):
        return partial(can_text.trace_frames, path)
    if suffix in can_log.SUFFIXES:
        return partial(can_log.log_frames, path)
    if suffix == ".csv" and can_text.is_gvret(path):
        return partial(can_text.gvret_frames, path)
    return None


def _read_bag(path: Path, profile: Profile | None, database: Database | None) -> Recording:
    requested_signals = None if profile is None else profile.needed_signals()
    # A profile may need only signals of topics, which begin with "/".
    needs_frames = requested_signals is None or any(
        not signal.startswith("/") for signal in requested_signals
    )
    with rosbag.open_bag(path) as reader:
        if not needs_frames or not rosbag.has_frames(reader):
            return rosbag.read_bag(reader, path, requested_signals).topics
        content = rosbag.read_bag(reader, path, requested_signals, _identifiers_of(database))
    frames = content.frames, content.first_frame_s
    decoded = _decode_frames(lambda _: frames, path, profile, database)
    return rosbag.add_topics(decoded, content.topics)


def _identifiers_of(database: Database | None) -> set[int] | None:
    """Return the identifiers of the messages in a CAN database; None without a database."""
    return None if database is None else {message.identifier for message in database.values()}


def _read_mdf(path: Path, profile: Profile | None, database: Database | None) -> Recording:
    requested_signals = None if profile is None else profile.needed_signals()
    content = mdf.read_isolated(path, _identifiers_of(database), requested_signals)
    if content.recording is not None:
        return content.recording
    return _decode_frames(lambda _: content.frames or ({}, 0.0), path, profile, database)


def _decode_frames(
    frames: can_log.Taker, path: Path, profile: Profile | None, database: Database | None
) -> Recording:
    if database is None:
        raise can_log.no_database(path)
    every = {
        f"{message.name}.{signal}" for message in database.values() for signal in message.signals
    }
    requested_signals = every if profile is None else profile.needed_signals()
    rules = list(profile.channels.values()) if profile else []
    buses = {rule.message: rule.bus for rule in rules if rule.message and rule.bus is not None}
    with foreign_errors(path, "CAN log"):
        recording = can_log.decode_log(frames, path.name, database, requested_signals, buses)
    recording.notes += can_log.notes_if_cut(path)
    return recording


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
        with open_durably(path) as file:
            pq.write_table(table, file, compression="zstd")
    except OSError as error:
        raise InputError(
            "out", f"cannot write {path} ({error})", "name a file in a writable folder"
        ) from error
