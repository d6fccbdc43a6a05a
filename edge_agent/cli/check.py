"""`edge-agent check`: run the signal doctor (automatic check of the signals) on a log; list the
signals without faults, and the faulty signals with their corrections.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from edge_agent.cli.options import add_json

if TYPE_CHECKING:
    from edge_agent.inputs.doctor.diagnosis import Diagnosis
    from edge_agent.inputs.signal_log import SignalLog
    from schemas.vehicle import Vehicle

NOT_PASSED = 1
FLAG_ROWS = 1000  # number of samples between two checks of the controller flags


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command-line arguments of `edge-agent check`."""
    parser.add_argument("log", type=Path, help="signal log (Parquet)")
    parser.add_argument(
        "--vehicle", type=Path, help="vehicle file (JSON) (default: LOG.json next to LOG.parquet)"
    )
    add_json(parser, "the findings")
    parser.add_argument("--out", type=Path, help="HTML page with the evidence and plots")
    parser.add_argument(
        "--fix",
        type=Path,
        metavar="PROFILE",
        help="write the corrected profile here, and the radius to the vehicle file",
    )


def run(args: argparse.Namespace) -> int:
    """Check the signals of a log. Return 0 if the log passes, 1 if a channel is faulty or unknown
    (neither confirmed nor faulty).
    """
    from edge_agent.app.backfill import vehicle_file_of
    from edge_agent.app.output_path import prepare_path
    from edge_agent.inputs.doctor.findings import diagnose
    from edge_agent.inputs.doctor.report import report_page
    from edge_agent.inputs.signal_log import read_log, require_log
    from schemas.runtime.durable import write_durably
    from schemas.vehicle import load_vehicle

    require_log(args.log)
    vehicle_file = args.vehicle or vehicle_file_of(args.log)
    vehicle = load_vehicle(vehicle_file)
    log = read_log(args.log)
    diagnosis = diagnose(log.t, log.signals, vehicle, log.ground)
    _print_report(args, diagnosis, _doubted_flags(log))
    if args.out is not None:
        out = prepare_path("out", args.out, (args.log, vehicle_file))
        write_durably(out, report_page(diagnosis, f"{args.log.name}, {vehicle.name}"))
    if args.fix is not None:
        _write_corrections(args, diagnosis, vehicle, vehicle_file)
    return 0 if diagnosis.is_passed else NOT_PASSED


def _print_report(
    args: argparse.Namespace, diagnosis: Diagnosis, doubted_flags: dict[str, str]
) -> None:
    from edge_agent.inputs.doctor.report import publishing_advice, report_document, report_lines

    if args.json:
        document = {"log": str(args.log), **report_document(diagnosis)}
        print(json.dumps({**document, "doubted_flags": doubted_flags}, allow_nan=False))
        return
    flags = [
        f"{'no weight':<10}{name} {reason}: it is treated as unknown"
        for name, reason in doubted_flags.items()
    ]
    advice = f"{args.log}: {publishing_advice(diagnosis)}"
    print("\n".join([*report_lines(diagnosis), *flags, advice]))


def _write_corrections(
    args: argparse.Namespace, diagnosis: Diagnosis, vehicle: Vehicle, vehicle_file: Path
) -> None:
    """Write the corrected profile and, if it changes, the vehicle file. Report the faults that
    cannot be corrected in either of them. If no fault can be corrected, write nothing.
    """
    from edge_agent.app.output_path import prepare_path
    from edge_agent.inputs.bring_in import profile_of
    from edge_agent.inputs.doctor.fix import apply_findings, list_corrections
    from schemas.runtime.durable import write_durably

    corrections = list_corrections(diagnosis)
    profile, corrected, left = apply_findings(corrections, profile_of(args.log), vehicle)
    for finding in left:
        _print_stderr(
            f"not corrected: {finding.channel} {finding.kind}: its recording must be decoded in "
            "another way"
        )
    if len(left) == len(corrections):
        _print_stderr(f"{args.fix}: not written: there is nothing to correct")
        return
    prepare_path("fix", args.fix, (args.log, vehicle_file))
    if corrected != vehicle:
        text = corrected.model_dump_json(indent=1, exclude_none=True) + "\n"
        write_durably(prepare_path("vehicle", vehicle_file), text)
        _print_stderr(f"{vehicle_file}: wheel_radius is now {corrected.wheel_radius:.4g} m")
    write_durably(args.fix, profile.to_json())
    _print_stderr(f"{args.fix}: the corrected profile; import the recording again with it")


def _doubted_flags(log: SignalLog) -> dict[str, str]:
    """Return the controller flags (ABS, ESC, traction control) that the estimator ignores as
    implausible at some time of a log. The result maps each flag's name to the reason.
    """
    from edge_agent.observe.controller_flags import doubted_flags, new_flag_records, trusted_context

    flags = new_flag_records(1)
    found = dict[str, str]()
    for block in log.blocks(0, rows=FLAG_ROWS):
        if block.context is not None:
            flags, _ = trusted_context(flags, block.t, block.signals, block.context)
            found |= {name: reason for _, name, reason in doubted_flags(flags) if name not in found}
    return found


def _print_stderr(line: str) -> None:
    print(line, file=sys.stderr)
