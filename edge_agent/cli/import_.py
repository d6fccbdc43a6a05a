"""`edge-agent import`: convert a car's recording to a signal log by a profile (assignment of
signals to channels). Without a profile, write a draft profile for the user to check.
"""

from __future__ import annotations

import argparse
import difflib
import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from edge_agent.cli.options import add_json, print_list
from schemas.errors import InputError
from schemas.runtime import commandline

if TYPE_CHECKING:
    from edge_agent.inputs.merge import Merged
    from edge_agent.inputs.profile import Profile
    from edge_agent.inputs.recording import Recording
    from schemas.numeric import FloatArray
    from schemas.vehicle import Vehicle

MOST_NAMES = 30  # maximum number of signal names in an error message


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command-line arguments of `edge-agent import`."""
    parser.add_argument(
        "source",
        type=Path,
        nargs="*",
        help="CSV, Parquet, BLF, ASC, candump, TRC, MF4, VBO, ROS bag, MCAP, NMEA, gpsd JSON",
    )
    parser.add_argument(
        "--profile", help="profile that maps signals to channels: a file, or a shipped one (--list)"
    )
    parser.add_argument("--list", action="store_true", help="list the shipped profiles and exit")
    add_json(parser, "the profiles")
    parser.add_argument("--dbc", type=Path, help="CAN database (default: the profile's)")
    parser.add_argument(
        "--vehicle", type=Path, help="vehicle file (JSON): supplies wheel radius and steering ratio"
    )
    parser.add_argument(
        "--draft", type=Path, help="where to write a drafted profile (default: next to the log)"
    )
    parser.add_argument(
        "--clock",
        action="append",
        default=[],
        metavar="FILE=SECONDS",
        help="seconds to add to the clock of a source",
    )
    parser.add_argument("--out", type=Path, help="signal log to write (Parquet)")


def run(args: argparse.Namespace) -> int:
    """Convert the recordings to a signal log, write a draft of a profile, or list the known
    profiles, as the options ask. Return 1 if the log lacks a channel that the estimators need,
    else 0.
    """
    from edge_agent.app.output_path import prepare_path
    from edge_agent.inputs.bring_in import read_source, write_log
    from edge_agent.inputs.memory import bounded_memory
    from edge_agent.inputs.profile import load_profile, shipped_profiles
    from edge_agent.inputs.readers.dbc import database_of
    from edge_agent.inputs.signal_log import require_no_estimates
    from schemas.runtime.durable import write_durably
    from schemas.vehicle import load_vehicle

    if args.list:
        print_list(
            {name: load_profile(name)[0].about for name in shipped_profiles()}, as_json=args.json
        )
        return 0
    _check_paths(args)
    shifts = _parse_shifts(args.clock)
    out = prepare_path("out", args.out)
    profile, folder = load_profile(args.profile) if args.profile else (None, Path())
    vehicle = load_vehicle(args.vehicle) if args.vehicle else None
    database = database_of(profile, folder, args.dbc)
    recordings = [read_source(path, profile, database) for path in args.source]
    _check_shifts(shifts, recordings)
    for path, recording in zip(args.source, recordings, strict=True):
        require_no_estimates(path, recording.signals)
    draft_path = args.draft or out.with_suffix(".profile.json")
    draft = None
    if profile is None:
        profile = _make_draft(recordings, out, draft_path)
        draft = profile
    with bounded_memory(args.source[0]):  # a clock that jumps by years gives too many rows
        merged, profile = _merge(recordings, profile, vehicle, shifts)
    write_log(out, merged, profile, [source.name for source in args.source])
    if draft is not None:
        write_durably(draft_path, draft.to_json())
        drafted = f"drafted from names, {len(draft.channels)} channels; check it before use"
        print(f"{draft_path}: {drafted}")
    if merged.start_ns is None:
        merged.notes.append("no source has a date; replay --publish needs --start")
    lacking = _lacking_channels(merged.columns)
    for note in [*merged.notes, *_missing_signals(lacking, profile, recordings)]:
        print(f"note: {note}")
    print(f"{out}: {len(merged.t)} rows, {merged.t[-1]:.1f} s, {', '.join(merged.columns)}")
    if lacking:
        where = args.profile or draft_path
        print(_warn_lacking(lacking, where, profile, recordings), file=sys.stderr)
    return commandline.FAILED if lacking else 0


def _check_paths(args: argparse.Namespace) -> None:
    """Raise an InputError if a path is missing, or an output would overwrite another file."""
    if not args.source or args.out is None:
        raise InputError(
            "source", "sources and --out are needed", "name recordings, and the log to write"
        )
    commandline.check_ending("out", args.out, (".parquet",))
    used = {source.resolve(): "one of the recordings" for source in args.source}
    if args.out.resolve() in used:
        raise InputError("out", f"{args.out} is one of the recordings", "name another file")
    used[args.out.resolve()] = "the signal log"
    if args.draft and (existing_use := used.get(args.draft.resolve())):
        raise InputError("draft", f"{args.draft} is {existing_use}", "name another file")


def _check_shifts(shifts: Iterable[str], recordings: Sequence[Recording]) -> None:
    """Raise an InputError if a time shift belongs to none of the recordings."""
    names = [recording.name for recording in recordings]
    for name in shifts:
        if name not in names:
            raise InputError(
                "clock", f"{name} is not one of the recordings", f"use {', '.join(names)}"
            )


def _make_draft(recordings: Sequence[Recording], out: Path, target: Path) -> Profile:
    """Return a draft of a profile for the recordings, from the names of their signals. `out` is the
    signal log to write, and `target` the file that will contain the draft.

    Raises:
        InputError: no signal has a known name, or `target` cannot be written or was edited.
    """
    from edge_agent.app.output_path import prepare_path
    from edge_agent.inputs.names import draft_profile

    units = {
        name: series.unit
        for recording in reversed(recordings)
        for name, series in recording.signals.items()
    }
    profile = draft_profile(units, out.stem)
    if not profile.channels:
        seen = ", ".join(sorted(units)[:MOST_NAMES]) or "nothing"
        raise InputError(
            "source",
            f"no signal has a known name; names in the file: {seen}",
            "write a profile that names them",
        )
    prepare_path("draft", target)
    if target.exists() and target.read_bytes() != profile.to_json().encode():
        raise InputError(
            "draft",
            f"{target} exists and may have been edited",
            "use it with --profile, or name another file with --draft",
        )
    return profile


def _merge(
    recordings: Sequence[Recording],
    profile: Profile,
    vehicle: Vehicle | None,
    shifts: Mapping[str, float],
) -> tuple[Merged, Profile]:
    """Return the merged signal log and its profile. With a vehicle, the delays that the signal
    doctor measures are corrected in both.
    """
    from edge_agent.inputs.doctor.adopt import align_import
    from edge_agent.inputs.merge import merge_recordings

    if vehicle is None:
        return merge_recordings(recordings, profile, shifts=shifts), profile
    merge_with = partial(
        merge_recordings,
        recordings,
        wheel_radius=vehicle.wheel_radius,
        steering_ratio=vehicle.steering_ratio,
        shifts=shifts,
    )
    return align_import(merge_with(profile), profile, vehicle, merge_with)


def _lacking_channels(columns: Mapping[str, FloatArray]) -> list[str]:
    """Return the channels that the estimators need and that have no reading in `columns`."""
    from edge_agent.inputs.log_columns import FRONT_STEERING, NEEDED

    read = {name for name, values in columns.items() if any(map(math.isfinite, values))}
    lacking = [name for name in NEEDED if name not in read]
    return [*lacking, *FRONT_STEERING[:1]] if read.isdisjoint(FRONT_STEERING) else lacking


def _warn_lacking(
    lacking: Iterable[str], where: object, profile: Profile, recordings: Iterable[Recording]
) -> str:
    """Return the warning that a log lacks channels. `where` is the profile that must name them."""
    recorded = {name for recording in recordings for name in recording.signals}
    unused = sorted(recorded - profile.needed_signals())[:MOST_NAMES]
    choice = f"; signals without a channel: {', '.join(unused)}" if unused else ""
    return (
        f"warning: no reading of {', '.join(lacking)}: check and replay refuse this log; name the "
        f"signals in the profile (--profile {where}), or add a source that has them{choice}"
    )


def _missing_signals(
    channels: Iterable[str], profile: Profile, recordings: Sequence[Recording]
) -> list[str]:
    """Return a note for each of the `channels` whose signals the profile names although no
    recording has them. For a misspelt signal it proposes the most similar one.
    """
    recorded = sorted({name for recording in recordings for name in recording.signals})
    notes = []
    for name in channels:
        wanted = profile.channels[name].needed_signals() if name in profile.channels else []
        for signal in [signal for signal in wanted if signal not in recorded]:
            similar = difflib.get_close_matches(signal, recorded, 1)
            guess = f"; did you mean {similar[0]}?" if similar else ""
            notes.append(f"{name}: no recording has the signal {signal}{guess}")
    return notes


def _parse_shifts(texts: list[str]) -> dict[str, float]:
    shifts = {}
    for text in texts:
        name, _, seconds = text.rpartition("=")
        try:
            shift = float(seconds)
        except ValueError:
            shift = math.nan
        if not math.isfinite(shift):
            raise InputError(
                "clock", f"{text!r} is not a time shift", "write it like drive.nmea=-0.4"
            )
        shifts[Path(name).name] = shift
    return shifts
