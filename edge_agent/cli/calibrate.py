"""`edge-agent calibrate`: learn the device errors of a car from its drives; writes a vehicle file."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("log", type=Path, nargs="+", help="signal logs (Parquet) of one car")
    parser.add_argument("--vehicle", type=Path, required=True, help="vehicle file to start from (JSON)")
    parser.add_argument("--out", type=Path, required=True, help="vehicle file to write (JSON)")
    parser.add_argument("--trust", action="store_true", help="learn from logs that the signal doctor did not pass")


def run(args: argparse.Namespace) -> int:
    """Learn and write; return 0."""
    from edge_agent.app.estimates_file import writable
    from edge_agent.calibration.learn import learn
    from edge_agent.inputs.doctor.findings import diagnose
    from edge_agent.inputs.signal_log import read_log
    from schemas.errors import InputError
    from schemas.vehicle import load_vehicle

    vehicle = load_vehicle(args.vehicle).model_copy(update={"calibration": None})
    drives = []
    for path in args.log:
        log = read_log(path)
        faults = [] if args.trust else diagnose(log.t, log.signals, vehicle, log.ground).findings
        if faults:
            names = ", ".join(f"{fault.channel} {fault.kind}" for fault in faults)
            raise InputError("log", f"{path}: {names}", "correct its profile (edge-agent check), or --trust it")
        drives.append((log.t, log.signals))
    calibration = learn(drives, vehicle)
    text = vehicle.model_copy(update={"calibration": calibration}).model_dump_json(indent=1, exclude_none=True)
    writable("out", args.out).write_text(text + "\n", encoding="utf-8")
    for name, estimate in calibration.model_dump(exclude_none=True).items():
        if isinstance(estimate, tuple):
            print(f"{name:<14} {estimate[0]:+.5f} ± {estimate[1]:.5f}")
    print(f"{args.out}: learned from {len(drives)} drives")
    return 0
