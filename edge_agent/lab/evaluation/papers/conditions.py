"""The papers' conditions: vehicle models with the papers' tyres and without drag, and the
manoeuvres that they drive.

A "matched" vehicle is a simulated vehicle ("plant") that has exactly the equations of the filter in
the paper. It usually has neither air drag nor rolling resistance. Drives at constant speed are an
exception: there both are simulated, and the filter knows them. Otherwise the car would need no
driving force at constant speed, and its tyres would give no information on friction.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from edge_agent.dynamics.parameters import Parameter, parameter_row
from edge_agent.estimators.common.tyre_option import TyreOption
from edge_agent.estimators.literal.given_motion import GivenMotion
from edge_agent.lab.evaluation.batch import DriveSet, DriveSpec
from edge_agent.lab.evaluation.scenarios import LIGHT, PAPERS, SEDAN, SMALL, STRONG, steered_behind
from edge_agent.lab.simulation.manoeuvres import TimedFriction, kmh, split
from edge_agent.lab.simulation.motor import Pmsm
from edge_agent.lab.simulation.presets import TrueVehicle, as_printed, matched_to_papers
from schemas.thresholds import GRAVITY

ROLLING: Final = 0.008  # rolling resistance over load, in drives at constant speed
DRAG: Final = 0.4  # [N s^2/m^2] air drag over speed squared, in drives at constant speed
# Shape c of the Magic Formula that the filter of paper 002 assumes; its curvature e is 0.
SHAPE_002: Final = 1.4
FRONT_SLOPE_002: Final = 60_000.0  # cornering stiffness C_f of the front axle [N/rad], table 1
REAR_SLOPE_002: Final = 40_000.0  # cornering stiffness C_r of the rear axle [N/rad], table 1
INERTIA_002: Final = 7.143  # inertia J of wheel and motor [kg m^2]


def with_losses(vehicle: TrueVehicle) -> TrueVehicle:
    """Return the vehicle with drag and rolling resistance added."""
    return replace(vehicle, drag=DRAG, rolling=ROLLING)


def _in_wheel() -> tuple[TrueVehicle, TyreOption]:
    """Return the vehicle of paper 002 (in-wheel motors) and the tyre option for its filter. The
    vehicle has the cornering stiffnesses C_f, C_r and the wheel inertia J of the paper's table 1.
    The tyre option tells the filter the ratio of the two stiffnesses.
    """
    row = parameter_row(SMALL.vehicle)
    base = row[Parameter.TO_FRONT] + row[Parameter.TO_REAR]
    weight = row[Parameter.MASS] * GRAVITY
    front = FRONT_SLOPE_002 / (weight * row[Parameter.TO_REAR] / base)
    rear = REAR_SLOPE_002 / (weight * row[Parameter.TO_FRONT] / base)
    vehicle = SMALL.vehicle.model_copy(
        update={"cornering_stiffness": float(front * weight / 4.0), "wheel_inertia": INERTIA_002}
    )
    ratio = float(rear / front)
    return replace(SMALL, vehicle=vehicle, rear_slope=ratio), TyreOption(rear_slope=ratio)


IN_WHEEL, IN_WHEEL_TYRE = _in_wheel()
MOTORED: Final = replace(STRONG, motors=Pmsm())

LOW: Final = (0.2, 0.25, 0.3, 0.35, 0.4, 0.45)  # friction values in table 7 of paper 003
CONSTANT_003: Final = DriveSpec("straight", SEDAN, None, kmh(40), duration_s=10.0)

MATCHED: Final[dict[str, DriveSpec]] = {
    "004.dlc": replace(PAPERS["004.dlc"], vehicle=as_printed(SEDAN)),
    "004.dlc.proportional": replace(
        PAPERS["004.dlc"], vehicle=as_printed(SEDAN, proportional=True)
    ),
    "000.jump": replace(
        PAPERS["000.jump"], vehicle=as_printed(steered_behind(kmh(30)), proportional=True)
    ),
    "000.jump.similarity": replace(PAPERS["000.jump"], vehicle=as_printed(steered_behind(kmh(30)))),
    **{
        name: replace(PAPERS[name], vehicle=as_printed(PAPERS[name].vehicle))
        for name in ("001.dlc", "001.sine", "001.slalom", "001.gaining.dlc", "001.gaining.slalom")
    },
    # The rear wheels are not steered as in equation (53), so that v_y is not almost zero.
    "001.dlc.front": replace(PAPERS["001.dlc"], vehicle=as_printed(LIGHT)),
    **{
        name: replace(
            PAPERS[name],
            vehicle=replace(matched_to_papers(IN_WHEEL), shape=SHAPE_002, curvature=0.0),
        )
        for name in ("002.sine", "002.jturn")
    },
    "002.sine.drag": replace(
        PAPERS["002.sine"],
        vehicle=replace(matched_to_papers(IN_WHEEL), shape=SHAPE_002, curvature=0.0, drag=DRAG),
    ),
    "003.accel": DriveSpec("throttle", as_printed(MOTORED, proportional=True), 0.85, kmh(20)),
    "003.turn": replace(
        PAPERS["003.turn"],
        vehicle=with_losses(as_printed(MOTORED, proportional=True)),
        duration_s=10.0,
    ),
    "003.split": replace(
        CONSTANT_003,
        vehicle=with_losses(as_printed(MOTORED, proportional=True)),
        mu=split(0.30, 0.85),
    ),
    "003.jump": DriveSpec(
        "throttle", as_printed(MOTORED, proportional=True), TimedFriction(0.85, 0.50, 4.0), kmh(20)
    ),
    **{
        f"003.low.{mu:g}": replace(
            CONSTANT_003, vehicle=with_losses(as_printed(MOTORED, proportional=True)), mu=mu
        )
        for mu in LOW
    },
}


def given_motion(batch: DriveSet, vehicle: TrueVehicle) -> GivenMotion:
    """Return the first drive of the batch with its true motion, as input of those filters that are
    implemented literally as printed in the papers. They need the true motion, because they do not
    estimate it.
    """
    truth = batch.truth
    return GivenMotion(
        batch.vehicles[0],
        batch.t[:, 0],
        truth["true_vx"][:, 0],
        truth["true_vy"][:, 0],
        batch.signals[:, 0],
        vehicle.rolling,
        vehicle.drag,
    )
