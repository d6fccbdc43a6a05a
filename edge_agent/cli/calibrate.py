"""`edge-agent calibrate`: learn the sensor errors of a car from its drives, and write a vehicle
file.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from edge_agent.calibration.held_out import Drive, HeldOut, Prediction
    from schemas.vehicle import Vehicle

ESTIMATOR: Final = "aco-fckf"
UNITS: Final = {
    "ax": "m/s^2",
    "ay": "m/s^2",
    "yaw_rate": "rad/s",
    "steer_offset": "rad",
    "wheel_lag": "s",
    "steer_lag": "s",
    "understeer": "rad per m/s^2",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command-line arguments of `edge-agent calibrate`."""
    parser.add_argument("log", type=Path, nargs="+", help="signal logs (Parquet) of one car")
    parser.add_argument(
        "--vehicle", type=Path, required=True, help="vehicle file to start from (JSON)"
    )
    parser.add_argument("--out", type=Path, required=True, help="vehicle file to write (JSON)")
    parser.add_argument(
        "--trust", action="store_true", help="accept logs that did not pass the signal doctor"
    )


def run(args: argparse.Namespace) -> int:
    """Learn a calibration, validate it on held-out drives, and write the vehicle file; return 0."""
    from edge_agent.app.output_path import prepare_path
    from edge_agent.calibration.held_out import learn_validated
    from schemas.errors import InputError
    from schemas.runtime.durable import write_durably
    from schemas.vehicle import load_vehicle

    vehicle = load_vehicle(args.vehicle).model_copy(update={"calibration": None})
    out = prepare_path("out", args.out, args.log)
    for path in args.log:
        if args.log.count(path) > 1:
            raise InputError("log", f"{path} is given twice", "give each drive once")
    drives = [_read_drive(path, vehicle, trusted=args.trust) for path in args.log]
    without_radii = vehicle.model_copy(
        update={"wheel_radius_front": None, "wheel_radius_rear": None}
    )
    found = learn_validated(drives, without_radii, predict_drive)
    text = vehicle.model_copy(update={"calibration": found.calibration}).model_dump_json(
        indent=1, exclude_none=True
    )
    write_durably(out, text + "\n")
    print("\n".join(report_lines(found)))
    print(f"{out}: learned from {len(drives)} {'drive' if len(drives) == 1 else 'drives'}")
    return 0


def _read_drive(path: Path, vehicle: Vehicle, *, trusted: bool) -> Drive:
    """Return the times and signals of a log. Raise an InputError if the signal doctor finds a fault
    in it, unless the user trusts it.
    """
    from edge_agent.inputs.correct import scale_axles
    from edge_agent.inputs.doctor.findings import diagnose
    from edge_agent.inputs.driving_direction import sign_wheels
    from edge_agent.inputs.signal_log import read_log
    from schemas.errors import InputError

    log = read_log(path)
    signals = scale_axles(log.signals, vehicle)
    faults = [] if trusted else diagnose(log.t, signals, vehicle, log.ground).findings
    if faults:
        names = ", ".join(f"{fault.channel} {fault.kind}" for fault in faults)
        raise InputError(
            "log", f"{path}: {names}", "correct its profile (edge-agent check), or --trust it"
        )
    return log.t, sign_wheels(log.t, signals, vehicle)


def predict_drive(vehicle: Vehicle, drive: Drive) -> Prediction:
    """Run an estimator with the vehicle parameters `vehicle` on a recorded drive. Return a score of
    how well the estimator predicts each next measurement of the drive.
    """
    from edge_agent.app.estimator_factory import bank_of
    from edge_agent.calibration.held_out import Prediction
    from edge_agent.estimators.estimates import Column
    from edge_agent.inputs.correct import correct_log
    from schemas.signals import Health

    t, signals = drive
    values = (
        bank_of(ESTIMATOR, [vehicle])
        .advance(t[:, None], correct_log(t, signals, vehicle)[:, None])
        .values[:, 0]
    )
    contradicted = (values[:, Column.HEALTH].astype(int) & int(Health.CONTRADICTION)) != 0
    likelihood = float(values[:, Column.INNOVATION_LOG_LIKELIHOOD].sum())
    return Prediction(likelihood / max(float(t[-1] - t[0]), 1e-9), float(contradicted.mean()))


def report_lines(found: HeldOut) -> list[str]:
    """Return the lines of the report on a learned calibration: learned values with units, groups of
    quantities left out because they do not improve predictions, and scores on held-out drives.
    """
    lines = []
    for name, estimate in found.calibration.model_dump(exclude_none=True).items():
        if isinstance(estimate, tuple):
            lines.append(
                f"{name:<14} {estimate[0]:+.5f} ± {estimate[1]:.5f} {UNITS.get(name, '1')}"
            )
    lines += [
        f"not written: {group}: it does not improve a held-out drive" for group in found.refused
    ]
    before = found.score_without
    after = found.score_with
    lines.append(
        f"held-out drives ({found.folds}): predictive log-likelihood {before.log_likelihood:.2f} "
        f"-> {after.log_likelihood:.2f} nat/s, contradicted {before.contradicted:.3f} -> "
        f"{after.contradicted:.3f}"
    )
    return lines
