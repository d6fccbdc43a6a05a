"""Evaluation of file import: decoded values compared with cantools, time to import a minute of a
bus, and equal estimates of one drive in all formats.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from edge_agent.app.estimator_factory import bank_of
from edge_agent.inputs.bring_in import read_source, write_log
from edge_agent.inputs.merge import merge_recordings
from edge_agent.inputs.profile import Channel, Profile, load_profile, shipped_profiles
from edge_agent.inputs.readers.can_log import Log, log_frames
from edge_agent.inputs.readers.dbc import LONGEST, Database, parse_dbc, read_dbc
from edge_agent.inputs.recording import import_optional
from edge_agent.inputs.signal_log import read_log
from schemas.numeric import FloatArray
from schemas.runtime.figures import Figure
from schemas.signals import CHANNELS as ALL
from tests.benchmarks.inputs.formats import as_bag, as_csv, as_log, as_mf4
from tests.benchmarks.inputs.peers import CHANNELS, DBC, STEP, profile_of
from tests.benchmarks.inputs.planted import Recorded, drives

MADE: Final = 200  # generated frames of each message
MINUTE_FRAMES: Final = 99_000
OTHERS: Final = 40  # CAN identifiers on the bus that no profile reads
TRIES: Final = 3
DRIVE_S: Final = 30
START_S: Final = 1_700_000_000


def decode_errors(recorded: Path | None, seed: int) -> tuple[int, int]:
    """Decode CAN frames with this project's code and with cantools. Return (number of values that
    differ, number of compared values).

    For every shipped profile with a CAN database, frames of random bytes are decoded, and also the
    frames of the log `recorded` if it is given.
    """
    wrong = 0
    compared = 0
    rng = np.random.default_rng(seed)
    for name in shipped_profiles():
        profile, folder = load_profile(name)
        if profile.dbc is None:
            continue
        ours = read_dbc(folder / profile.dbc)
        oracle = import_optional("cantools", "dev").database.load_file(folder / profile.dbc)
        frames = {
            message.name: [rng.bytes(message.length) for _ in range(MADE)]
            for message in oracle.messages
        }
        if recorded is not None:
            log, _ = log_frames(recorded, {message.identifier for message in ours.values()})
            for message in oracle.messages:
                frames[message.name] += _recorded_frames(log, message)
        for message in oracle.messages:
            errors, values = _compare_decoders(ours, message, frames[message.name])
            wrong = wrong + errors
            compared = compared + values
    return wrong, compared


def _recorded_frames(log: Log, message: Any) -> list[bytes]:  # noqa: ANN401 cantools has no types
    """Return the data bytes of all frames in a recorded CAN log whose identifier is that of the CAN
    message `message`. The frames may be from any bus.
    """
    wanted = (message.frame_id, message.is_extended_frame)
    return [
        bytes(row[: message.length])
        for (_, *identity), received in log.items()
        if tuple(identity) == wanted
        for row in received.to_columns()[1]
    ]


def _compare_decoders(
    ours: Database,
    message: Any,  # noqa: ANN401 cantools has no types
    frames: Sequence[bytes],
) -> tuple[int, int]:
    table = np.frombuffer(
        b"".join(frame.ljust(LONGEST, b"\0") for frame in frames), np.uint8
    ).reshape(-1, LONGEST)
    oracle = [message.decode(frame, decode_choices=False) for frame in frames]
    decoded = ours[message.name].decode(table, list(ours[message.name].signals))
    pairs = [
        (float(row.get(signal, np.nan)), value)
        for signal, values in decoded.items()
        for row, value in zip(oracle, values.tolist(), strict=True)
    ]
    return sum(a != b and not (np.isnan(a) and np.isnan(b)) for a, b in pairs), len(pairs)


def on_a_bus(drive: Recorded) -> list[Any]:
    """Encode the signals of a drive as CAN frames, and return the frames. Each frame contains two
    channels of one sample. A frame is left out if one of its two readings is missing.
    """
    frames = []
    columns = drive.signals[:, [ALL.index(name) for name in CHANNELS]]
    for t, row in zip(drive.t, columns, strict=True):
        for k in range(0, len(row), 2):
            if np.isfinite(row[k : k + 2]).all():
                data = struct.pack("<ii", *(round(value / STEP) for value in row[k : k + 2]))
                frames.append(_make_frame(t + 1e-4 * k, 256 + k // 2, data))
    return frames


# python-can has no types.
def _make_frame(t: float, identifier: int, data: bytes) -> Any:  # noqa: ANN401
    stamp = round(START_S + t, 6)
    return import_optional("can").Message(
        timestamp=stamp, arbitration_id=identifier, is_extended_id=False, data=data, channel=1
    )


def a_minute(path: Path) -> Path:
    """Write a CAN log of one minute with MINUTE_FRAMES frames, and return its path. It contains
    four messages that the import must decode, at 100 Hz, and OTHERS messages that the import must
    ignore.
    """
    rng = np.random.default_rng(1)
    others = rng.choice(np.arange(512, 512 + OTHERS), MINUTE_FRAMES - 24_000)
    chosen = np.concatenate([np.tile(np.arange(256, 260), 6000), others])
    rng.shuffle(chosen)
    data = rng.bytes(8)
    return as_log(
        path, [_make_frame(60.0 * k / len(chosen), int(one), data) for k, one in enumerate(chosen)]
    )


def import_file(path: Path, profile: Profile, out: Path) -> Path:
    """Import a source as a signal log, like `edge-agent import`; return the path of the log."""
    database = parse_dbc(DBC) if path.suffix != ".csv" else None
    merged = merge_recordings([read_source(path, profile, database)], profile)
    write_log(out, merged, profile, [path.name])
    return out


def import_s(folder: Path) -> float:
    """Return the time [s] to import a CAN log of one minute, the shortest of TRIES runs."""
    path = a_minute(folder / "minute.blf")
    profile = profile_of("can")
    spent = []
    for _ in range(TRIES):
        began = time.perf_counter()
        import_file(path, profile, folder / "minute.parquet")
        spent.append(time.perf_counter() - began)
    return min(spent)


def estimates_of(log: Path, drive: Recorded) -> FloatArray:
    """Return all outputs of the default estimator, (T, 1, columns), for the T samples of an
    imported signal log.
    """
    read = read_log(log)
    return np.asarray(
        bank_of("aco-fckf", [drive.vehicle]).advance(read.t[:, None], read.signals[:, None]).values
    )


def same_estimates(folder: Path, seed: int, seconds: int = DRIVE_S) -> tuple[float, int]:
    """Write one drive in every format, import and estimate it; return (largest difference between
    these estimates, number of formats).
    """
    (drive,) = drives(1, seed, rough=True, seconds=seconds)
    frames = on_a_bus(drive)
    profile = profile_of("can")
    paths = [as_log(folder / f"drive.{kind}", frames) for kind in ("blf", "asc", "log")]
    paths += [as_mf4(folder / "drive.mf4", frames), as_bag(folder / "bag", frames)]
    logs = [import_file(path, profile, folder / f"{path.name}.parquet") for path in paths]
    csv = as_csv(folder / "drive.csv", logs[0])
    plain = Profile(name="csv", channels={name: Channel(signal=name) for name in CHANNELS})
    logs.append(import_file(csv, plain, folder / "csv.parquet"))
    first, *others = (estimates_of(log, drive) for log in logs)
    differences = [_largest_difference(first, other) for other in others]
    return max(differences), len(logs)


def _largest_difference(one: FloatArray, other: FloatArray) -> float:
    if one.shape != other.shape or not np.array_equal(np.isnan(one), np.isnan(other)):
        return float("inf")
    return float(np.nanmax(np.abs(one - other)))


def figures(folder: Path, seed: int, recorded: Path | None, seconds: int = DRIVE_S) -> list[Figure]:
    """Return the figures of the import of recorded files (errors, durations), each with the number
    of values or formats on which it is based.
    """
    wrong, compared = decode_errors(recorded, seed)
    largest, formats = same_estimates(folder, seed, seconds)
    return [
        Figure("inputs.decode_errors", float(wrong), "values", 0.0),
        Figure("inputs.decoded", float(compared), "values", 60_000.0, "more"),
        Figure("inputs.import_s", import_s(folder), "s", 1.5),
        Figure("inputs.same_estimates", largest, "1", 1e-6),
        Figure("inputs.formats", float(formats), "formats", 6.0, "more"),
    ]
