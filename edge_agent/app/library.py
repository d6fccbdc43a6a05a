"""Functions of the Python library: estimate a log, and return the result as a table or a plot."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa

from edge_agent.adaptation.memberships import Memberships
from edge_agent.app import tuned_memberships
from edge_agent.app.estimates_file import estimates_table
from edge_agent.app.estimator_factory import bank_of
from edge_agent.estimators import Estimates, EstimatorBank
from edge_agent.inputs import signal_log
from edge_agent.inputs.doctor.adopt import prepare_log
from edge_agent.inputs.signal_log import SignalLog
from schemas.errors import InputError
from schemas.numeric import FloatArray
from schemas.runtime.installing import install_command
from schemas.runtime.palette import line_of
from schemas.tables import ESTIMATES_SCHEMA
from schemas.vehicle import Vehicle
from schemas.vehicle import load_vehicle as load_vehicle_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DEFAULT = "aco-fckf"


def read_log(path: Path | str) -> SignalLog:
    """Return a signal log (Parquet): t (T,) [s] and signals (T, 18) in the order of
    schemas.signals.CHANNELS, in SI units.

    Raises:
        InputError: the file cannot be read, or lacks a required column. The error names the column,
            the row and the fix.
    """
    return signal_log.read_log(Path(path))


def load_vehicle(path: Path | str) -> Vehicle:
    """Return the vehicle in a vehicle file (JSON).

    Raises:
        InputError: the file cannot be read, or a field is invalid; the error names the field.
    """
    return load_vehicle_file(Path(path))


def load_memberships(path: Path | str) -> Memberships:
    """Return the fuzzy sets in a file that `edge-agent tune` wrote.

    Raises:
        InputError: the file cannot be read, or a field is invalid; the error names the field.
    """
    return tuned_memberships.load_tuned(path).memberships


def make_bank(
    estimator: str, vehicles: Sequence[Vehicle], *, memberships: Memberships | None = None
) -> EstimatorBank:
    """Return a bank of estimators, one per vehicle. Call `bank.advance(t, signals)` with t (T, N)
    and signals (T, N, 18).

    Raises:
        InputError: the estimator is unknown, no vehicle is given, or memberships (fuzzy sets) are
            given for an estimator that has none.
    """
    return bank_of(estimator, vehicles, memberships)


def estimate(
    log: SignalLog,
    vehicle: Vehicle,
    estimator: str = DEFAULT,
    *,
    memberships: Memberships | None = None,
) -> pa.Table:
    """Return the estimates of a log, one row per sample, with the columns of
    schemas.tables.ESTIMATES.

    As in `edge-agent replay`, two kinds of error are corrected in the signals first: sensor errors
    that the vehicle file states (from a calibration), and delays that the signal doctor (automatic
    check) measures.
    """
    log, vehicle, *_ = prepare_log(log, vehicle)
    bank = bank_of(estimator, [vehicle], memberships)
    parts = [
        estimates_table(block.t, bank.advance(block.t, block.signals)) for block in log.blocks(0)
    ]
    return pa.concat_tables([*parts, ESTIMATES_SCHEMA.empty_table()]).combine_chunks()


def to_table(t: FloatArray, estimates: Estimates, vehicle: int = 0) -> pa.Table:
    """Return the estimates of one of N vehicles as a table with T rows. `vehicle` is the vehicle's
    index, and the times `t` [s] have shape (T, N) or (T,).

    Raises:
        InputError: there is no vehicle with this index.
    """
    count = estimates.values.shape[1]
    if not 0 <= vehicle < count:
        raise InputError(
            "vehicle", f"{vehicle} is not one of the {count} vehicles", f"give 0 to {count - 1}"
        )
    time = np.asarray(t if t.ndim == 1 else t[:, vehicle])[:, None]
    return estimates_table(time, Estimates(estimates.values[:, vehicle : vehicle + 1]))


def plot(
    estimates: dict[str, pa.Table], *, truth: pa.Table | None = None, title: str = ""
) -> Figure:
    """Plot speed and friction with its 90 % interval over time, for several estimators by name.
    `truth` is the table of a simulated log; if given, its true friction and speed are plotted too.

    Raises:
        InputError: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise InputError(
            "plot", "matplotlib is not installed", install_command("analytics")
        ) from error
    figure = Figure(figsize=(8, 6), layout="constrained")
    speed, friction = figure.subplots(2, 1, sharex=True)
    if truth is not None:
        wheels = [
            truth[name].to_numpy() for name in truth.schema.names if name.startswith("true_mu_")
        ]
        speed.plot(truth["t"], truth["true_vx"], color="k", label="true")
        friction.plot(
            truth["t"], np.mean(wheels, axis=0), color="k", label="true, mean of the wheels"
        )
    for name, found in estimates.items():
        style = line_of(name)
        t = found["t"].to_numpy()
        speed.plot(t, found["vx"].to_numpy(), color=style.colour, linestyle=style.dash, label=name)
        friction.plot(
            t,
            found["mu"].to_numpy(),
            color=style.colour,
            linestyle=style.dash,
            label=f"{name}, median",
        )
        ends = (found[end].to_numpy() for end in ("mu_lower", "mu_upper"))
        friction.fill_between(
            t, *ends, color=style.colour, alpha=0.2, linewidth=0, label="90 % band"
        )
    speed.set(ylabel="v_x [m/s]", title=title)
    friction.set(ylabel="peak adhesion μ [1]", xlabel="t [s]", ylim=(0.0, 1.25))
    for axes in (speed, friction):
        axes.legend(fontsize="x-small")
    return figure


def known_estimators() -> Iterator[tuple[str, str]]:
    """Yield (name, one-line description) of all estimators, including estimators of other installed
    packages.
    """
    from edge_agent.app.estimator_factory import known_estimators

    yield from known_estimators().items()
