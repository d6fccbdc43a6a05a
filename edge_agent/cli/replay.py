"""`edge-agent replay`: estimate recorded drives as fast as possible; with --publish, send one drive
to the fleet service.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from edge_agent.cli.options import add_connection, add_estimator, config_of, memberships_of
from schemas.errors import InputError
from schemas.runtime import commandline, progress_messages
from schemas.thresholds import NS

if TYPE_CHECKING:
    from edge_agent.adaptation.memberships import Memberships
    from edge_agent.app.backfill import Outcome
    from edge_agent.app.live_loop import Progress
    from edge_agent.app.plausible import Plausibility
    from edge_agent.estimators import EstimatorBank
    from edge_agent.inputs.signal_log import SignalLog
    from edge_agent.observe.observation_builder import RecordBlock
    from edge_agent.observe.pipeline import Pipeline
    from edge_agent.publish.publisher import Publisher
    from schemas.config import AgentConfig
    from schemas.vehicle import Vehicle

NOW = "now"
REPORTS = (".html", ".png", ".svg", ".pdf")
LOCAL = "local"
SPARK = "spark"
# [ns] age from which a record may be rejected: by default, a service rejects records that are more
# than thirty days old.
OLD_NS = 29 * 86_400 * NS
# [s] time to wait for the next answer of a busy service. Batches without an answer then stay in the
# outbox.
DRAIN_S = 30.0
CHECK_S = 0.05  # [s] time between two checks for answers
CLOSE_S = 1.0  # [s] time for the sender to end its present round
PROGRESS_S = 1.0  # [s] time between two progress lines


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command-line arguments of `edge-agent replay`."""
    parser.add_argument("log", type=Path, nargs="+", help="signal log (Parquet)")
    parser.add_argument(
        "--vehicle", type=Path, help="vehicle file (JSON) (default: LOG.json next to LOG.parquet)"
    )
    add_estimator(parser)
    parser.add_argument(
        "--out",
        type=Path,
        required=True,
        help="estimates (.parquet, .csv, .mcap), or a report to look at (.html, .png, .svg, .pdf); "
        "of several logs, a folder of estimates",
    )
    parser.add_argument(
        "--compare",
        metavar="NAME,NAME",
        help="more estimators on the same drive, side by side in a report",
    )
    parser.add_argument(
        "--jobs", type=int, default=1, help="number of logs processed at a time (default 1)"
    )
    parser.add_argument(
        "--engine",
        default=LOCAL,
        metavar="local|spark",
        help="where to process several logs (default local)",
    )
    parser.add_argument(
        "--publish",
        action="store_true",
        help="send observations and states, wait for acknowledgement; a repeat counts once",
    )
    parser.add_argument(
        "--trust",
        action="store_true",
        help="publish a log that did not pass the signal doctor, and ignore its faults",
    )
    add_connection(parser, ", for --publish")
    parser.add_argument("--name", help="name to publish under (default: the vehicle file's)")
    parser.add_argument(
        "--start",
        help="time of t = 0, UTC without a zone, or 'now', such that it ends now (default: the "
        "log's, else now)",
    )


def run(args: argparse.Namespace) -> int:
    """Replay logs (estimate recorded drives). Return 0 if all estimates were written and all sent
    records were acknowledged, 1 if the service rejected records or did not answer, 3 if the
    estimates of a log are implausible.
    """
    config = config_of(args)
    estimator = args.estimator or config.estimator
    memberships = memberships_of(args)
    several = len(args.log) > 1 or args.out.is_dir()
    _check_engine(args.engine, args.jobs, several=several)
    if several:
        return _replay_several(args, estimator, memberships)
    return _replay_one(args, config, estimator, memberships)


def _replay_several(
    args: argparse.Namespace, estimator: str, memberships: Memberships | None
) -> int:
    """Write the estimates of several logs into a folder; return the exit code."""
    from edge_agent.app.backfill import backfill_on_spark, estimate_drives, tasks_of

    if args.publish:
        raise InputError(
            "publish",
            f"{len(args.log)} logs into a folder",
            "publish one log, to one file, at a time",
        )
    if args.compare is not None:
        raise InputError("compare", "needs one log", "write one report at a time")
    tasks = tasks_of(args.log, args.vehicle, args.out)  # raises if a log would be overwritten
    if args.engine == SPARK:
        outcomes = backfill_on_spark(tasks, estimator, memberships)
    else:
        outcomes = estimate_drives(tasks, estimator, args.jobs, memberships)
    return _print_outcomes(outcomes, len(tasks))


def _replay_one(
    args: argparse.Namespace,
    config: AgentConfig,
    estimator: str,
    memberships: Memberships | None,
) -> int:
    """Write the estimates or the report of one log, and publish its records if the options ask for
    this; return the exit code.
    """
    from edge_agent.app.backfill import vehicle_file_of
    from edge_agent.app.estimator_factory import bank_of
    from edge_agent.app.plausible import IMPLAUSIBLE, Plausibility
    from edge_agent.cli.common import checked_name, require_valid_signals, warn_about_faults
    from edge_agent.inputs.doctor.adopt import prepare_log
    from edge_agent.inputs.signal_log import read_log
    from schemas.vehicle import load_vehicle

    path = args.log[0]
    vehicle_file = args.vehicle or vehicle_file_of(path)
    _check_output(args, vehicle_file)
    vehicle = load_vehicle(vehicle_file)
    name = checked_name(args.name or vehicle.name) if args.publish else vehicle.name
    bank_of(estimator, [vehicle], memberships)  # raises for a wrong name before the log is read
    log = read_log(path)
    if args.publish:
        _require_position(path, log)
    start_ns = _start_time(args.start, log)
    log, vehicle, diagnosis, notes = prepare_log(log, vehicle)
    plausibility = Plausibility(vehicle.wheel_radius, bool(diagnosis.findings) and not args.trust)
    if args.publish and not args.trust:
        require_valid_signals(diagnosis)
    else:
        notes += warn_about_faults(diagnosis, path)
    code = 0
    if args.out.suffix in REPORTS:
        names = [estimator, *_split_names(args.compare)]
        notes += _write_report(args, log, vehicle, names, plausibility)
    else:
        drive = _Drive(log, name, start_ns, bank_of(estimator, [vehicle], memberships))
        if args.publish:
            code, further_notes = _replay_and_publish(args, config, estimator, drive, plausibility)
            notes += further_notes
        else:
            _write_estimates(args.out, drive, plausibility)
    print("\n".join([*notes, plausibility.summary_line()]), file=sys.stderr)
    if code == 0 and plausibility.problems():
        return IMPLAUSIBLE
    return code


class _Drive(NamedTuple):
    """Recorded drive of one vehicle, with the estimator bank of this vehicle.

    Attributes:
        log: signals of the drive.
        vehicle_name: name under which the records are published.
        start_ns: time of t = 0 [ns UTC].
        bank: estimator bank that has not seen the drive yet.
    """

    log: SignalLog
    vehicle_name: str
    start_ns: int
    bank: EstimatorBank


def _replay_and_publish(
    args: argparse.Namespace,
    config: AgentConfig,
    estimator: str,
    drive: _Drive,
    plausibility: Plausibility,
) -> tuple[int, list[str]]:
    """Write the estimates of a drive and publish its records. Return the exit code and notes for
    the user. Add the estimates to `plausibility`.
    """
    from edge_agent.app.publishing import open_publisher
    from edge_agent.observe.pipeline import Pipeline
    from edge_agent.publish.batching import batch_drive

    name = drive.vehicle_name
    pipeline = Pipeline(drive.bank, 1, config)
    records, progress = _make_records(args.out, drive, pipeline, plausibility)
    batches = batch_drive(records, name, estimator, config.batch_rows)
    publisher = open_publisher([name], config, estimator, drive=batches)
    start = ""
    if _is_start_now(args.start, drive.log):
        start = f" with --start {_start_text(drive.start_ns)}"
    code = _publish_drive(publisher, progress, drive.start_ns, f"repeat the command{start}")
    notes = []
    if not batches.drafts:
        notes.append(_explain_no_record(config))
    if start:
        if args.start is None:
            notes.append("note: the log has no date: published as if it ended now (see --start)")
        notes.append(f"note: repeated{start}, this drive counts once; otherwise it is another")
    return code, notes


def _explain_no_record(config: AgentConfig) -> str:
    """Return the note that a drive has no record to publish, with the probable reason."""
    reason = "the car completed no visit of a cell"
    if config.trip_end_m or config.trip_end_s:
        ends = f"trip_end_m {config.trip_end_m:g}, trip_end_s {config.trip_end_s:g}"
        reason = f"the ends of a trip are not published ({ends})"
    return f"note: nothing was published: {reason}"


def _require_position(path: Path, log: SignalLog) -> None:
    """Raise an InputError if a log has no position, because then no record could be published."""
    from schemas.signals import S

    place = abs(log.signals[:, [S.LATITUDE, S.LONGITUDE]])
    if not (place <= (90.0, 180.0)).all(axis=1).any():
        problem = f"{path} has no position, so there is nothing to publish"
        raise InputError("latitude", problem, "import it together with a GNSS log")


def _check_output(args: argparse.Namespace, vehicle_file: Path) -> None:
    """Raise an InputError if the output has an unknown ending, does not suit the options, or would
    overwrite an input.
    """
    from edge_agent.app.estimates_file import ENDINGS
    from edge_agent.inputs.signal_log import require_log

    if args.compare is not None and args.out.suffix not in REPORTS:
        raise InputError(
            "compare",
            f"works only with a report, not with {args.out.name}",
            f"write {', '.join(REPORTS)}",
        )
    if args.publish and args.out.suffix in REPORTS:
        raise InputError(
            "publish", "cannot be combined with a report", "replay twice: once with .parquet"
        )
    require_log(args.log[0])
    commandline.refuse_input_path("out", args.out, [args.log[0], vehicle_file])
    if args.out.suffix:
        commandline.check_ending("out", args.out, [*filter(None, ENDINGS), *REPORTS])


def _split_names(names: str | None) -> list[str]:
    return [] if names is None else [name.strip() for name in names.split(",") if name.strip()]


def _write_report(
    args: argparse.Namespace,
    log: SignalLog,
    vehicle: Vehicle,
    names: list[str],
    plausibility: Plausibility,
) -> list[str]:
    """Estimate a log with each estimator in `names`, write the report (plots of the estimates), and
    return notes for the user. Add the estimates of the first one to `plausibility`.
    """
    import pyarrow as pa

    from edge_agent.app import drive_report
    from edge_agent.app.estimator_factory import bank_of
    from edge_agent.app.library import to_table
    from edge_agent.app.output_path import prepare_path

    prepare_path("out", args.out)
    found = {}
    for name in dict.fromkeys(names):
        progress_messages.set_status(f"estimating with {name}")
        bank = bank_of(name, [vehicle], memberships_of(args) if name == names[0] else None)
        parts = []
        for block in log.blocks(0):
            estimates = bank.advance(block.t, block.signals)
            parts.append(to_table(block.t, estimates))
            if name == names[0]:
                plausibility.add(block.t, block.signals, estimates)
        found[name] = pa.concat_tables(parts)
    title = f"{args.log[0].name}: {vehicle.name}, {float(log.t[-1] - log.t[0]):.0f} s"
    drive_report.write_report(drive_report.RecordedDrive(log, found, title), args.out)
    return [f"note: {args.out} shows {', '.join(found)}"]


def _check_engine(engine: str, jobs: int, *, several: bool) -> None:
    if jobs < 1:
        raise InputError("jobs", f"{jobs} is below 1", "give at least one job")
    if engine not in (LOCAL, SPARK):
        raise InputError("engine", f"{engine!r} is unknown", f"use {LOCAL} or {SPARK}")
    if engine == SPARK and not several:
        raise InputError(
            "engine",
            "Spark needs several logs",
            "give several logs, or an existing folder",
        )
    if engine == SPARK and jobs != 1:
        raise InputError(
            "jobs",
            f"{jobs} has no effect on Spark",
            "set the number in Spark's master, e.g. local[4]",
        )


def _print_outcomes(outcomes: Iterator[Outcome], count: int) -> int:
    """Print the progress of estimating `count` recorded logs on stderr. Print an error for each log
    that could not be read, and warnings for faulty signals and implausible estimates. Return 2 if a
    log could not be read, else 3 if estimates are implausible, else 0.
    """
    from edge_agent.app.plausible import IMPLAUSIBLE

    bad = 0
    code = 0
    samples = 0
    began = time.monotonic()
    last = 0.0
    for done, outcome in enumerate(outcomes, 1):
        samples += outcome.samples
        if outcome.error is not None:
            bad += 1
            print(f"error: {outcome.task.log}: {outcome.error}", file=sys.stderr, flush=True)
        for fault in outcome.faults:
            print(f"warning: {outcome.task.log}: {fault}", file=sys.stderr)
        if outcome.implausible is not None:
            code = IMPLAUSIBLE
            print(f"warning: {outcome.task.log}: {outcome.implausible}", file=sys.stderr)
        elapsed = time.monotonic() - began
        if elapsed - last >= PROGRESS_S or done == count:
            last = elapsed
            rate = samples / max(elapsed, 1e-9)
            print(
                f"{done} of {count} logs, {samples} samples, {rate:.0f}/s",
                file=sys.stderr,
                flush=True,
            )
    return 2 if bad else code


def _write_estimates(out: Path, drive: _Drive, plausibility: Plausibility) -> None:
    """Estimate a drive. Write the estimates to the file `out`, and add them to `plausibility`."""
    from edge_agent.app.estimates_file import EstimatesFile

    with EstimatesFile(out) as file:
        for block in drive.log.blocks(drive.start_ns):
            estimates = drive.bank.advance(block.t, block.signals)
            plausibility.add(block.t, block.signals, estimates)
            file.write(block.t, estimates)


def _make_records(
    out: Path, drive: _Drive, pipeline: Pipeline, plausibility: Plausibility
) -> tuple[list[RecordBlock], Progress]:
    """Do the same as `_write_estimates` with the drive's bank in `pipeline`. Return the resulting
    records with the progress that the publisher reports.
    """
    from edge_agent.app.estimates_file import EstimatesFile
    from edge_agent.app.live_loop import Progress

    progress = Progress(signals_s=float(drive.log.t[-1] - drive.log.t[0]))
    found: list[RecordBlock] = []
    with EstimatesFile(out) as file:
        for block in drive.log.blocks(drive.start_ns):
            estimates, *records = pipeline.step(block)
            plausibility.add(block.t, block.signals, estimates)
            file.write(block.t, estimates)
            progress.blocks += 1
            found += records
        last = pipeline.finish()
    return (found if last is None else [*found, last]), progress


def _publish_drive(publisher: Publisher, progress: Progress, start_ns: int, advice: str) -> int:
    """Send the outbox of `publisher`, which contains the records of a log that begins at `start_ns`
    [ns UTC] and was estimated with `progress`. Return 1 if a record was refused, lost or not
    acknowledged, else 0. For the last two cases, print the instruction `advice`.
    """
    from edge_agent.app.publishing import close_publisher

    try:
        _wait_for_answers(publisher)
    finally:
        close_publisher(publisher, progress, CLOSE_S)
    if refused := sum(publisher.counts.rejected.values()):
        old = time.time_ns() - start_ns > OLD_NS
        fix = (
            "the log is older than a month: publish it with --start now"
            if old
            else "the reasons are above"
        )
        print(f"error: publish: {refused} records were refused; {fix}", file=sys.stderr)
    left = publisher.count_unsettled() or publisher.status.lost_records
    if left:
        print(
            f"error: publish: {left} records were not acknowledged; {advice}, no record counts "
            "twice",
            file=sys.stderr,
        )
    return 1 if refused or left else 0


def _wait_for_answers(publisher: Publisher) -> None:
    """Wait until the service has settled all records, or has not answered for DRAIN_S."""
    left = publisher.count_unsettled()
    answered = time.monotonic()
    while left and time.monotonic() - answered < DRAIN_S:
        progress_messages.set_status(f"sending {left} records")
        time.sleep(CHECK_S)
        if (unsettled := publisher.count_unsettled()) < left:
            left = unsettled
            answered = time.monotonic()


def _start_time(start: str | None, log: SignalLog) -> int:
    """Return the time [ns UTC] of t = 0 in a recorded log: the given time, else the time stated in
    the log, else a time such that the log ends now.
    """
    from schemas.config import parse_moment

    if start is not None and start != NOW:
        return parse_moment(start, "start")
    if start is None and log.start_ns is not None:
        return log.start_ns
    # A whole second, so that `_start_text` is exact.
    return (time.time_ns() - round(float(log.t[-1]) * NS)) // NS * NS


def _is_start_now(start: str | None, log: SignalLog) -> bool:
    """Return True if neither `--start` nor the log states the time of t = 0."""
    return start == NOW or (start is None and log.start_ns is None)


def _start_text(start_ns: int) -> str:
    return f"{datetime.fromtimestamp(start_ns // NS, UTC):%Y-%m-%dT%H:%M:%SZ}"
