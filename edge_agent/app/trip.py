"""Live trip of a car: the signal doctor (automatic check) verifies the car's signals, and a
calibration (sensor errors) is learned from them. Verdict and calibration are stored next to the
outbox (file of unsent records).

Nothing is published until the doctor has found the signals free of faults, in this trip or in an
earlier trip with the same vehicle file and profile. A trip is examined in sections of PART_S
seconds. The calibration is learned from each section without a fault. A section with a fault stops
the publishing until a later section has no fault. Learned values are used from the next trip on,
because an estimator's vehicle parameters are fixed during a trip.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Generator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Final, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from edge_agent.calibration.learn import DriveEstimates, one_drive, surer_values, weigh_estimates
from edge_agent.inputs.block import Block
from edge_agent.inputs.correct import Corrector
from edge_agent.inputs.doctor.findings import diagnose
from edge_agent.inputs.driving_direction import DrivingDirection, sign_wheels
from edge_agent.inputs.profile import Profile
from schemas.numeric import FloatArray
from schemas.runtime.durable import write_durably
from schemas.vehicle import Vehicle

PART_S: Final = 600.0  # [s] length of a section, 9 MB of signals
LOOK_S: Final = 30.0  # [s] time between examinations until one finds no fault
LEAST_S: Final = 60.0  # [s] minimum length of a section for learning
# Largest number of remembered sections. Older ones are forgotten, because tyres wear and are
# replaced.
MOST_DRIVES: Final = 50
LEAVE_S: Final = 1.0

log = logging.getLogger(__name__)


class Known(BaseModel):
    """Stored knowledge about a car. `of` is a hash of vehicle file and profile. `passed` is True if
    the signal doctor found no fault in the car's signals. `drives` contains the estimated sensor
    errors of each section of the car's trips.
    """

    model_config = ConfigDict(extra="forbid")

    version: Literal[1] = 1
    of: Annotated[
        str,
        Field(
            description="hash of vehicle file and profile; another hash discards the learned values"
        ),
    ]
    passed: bool = False
    drives: list[DriveEstimates] = []


class Trip:
    """One trip of one car.

    Args:
        vehicle: vehicle file of the car.
        profile: assignment of the car's signals to channels.
        path: file with the stored knowledge about the car; it need not exist.
        trusted: True to publish records whatever the signal doctor finds.
    """

    def __init__(
        self, vehicle: Vehicle, profile: Profile, path: Path, *, trusted: bool = False
    ) -> None:
        self._plain = vehicle.model_copy(update={"calibration": None})
        self._path = path
        self._trusted = trusted
        self._saved_state = _read_state(path, _car_identity(self._plain, profile))
        learned = weigh_estimates(self._saved_state.drives, self._plain)
        self.vehicle = vehicle.model_copy(
            update={"calibration": surer_values(vehicle.calibration, learned)}
        )
        # Blocks of the current section: t, signals, ground.
        self._blocks: list[tuple[FloatArray, FloatArray, FloatArray]] = []
        self._part_start = 0.0
        self._last_examination = 0.0
        self._faults: list[str] = []
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="doctor")
        self._examination: Future[None] | None = None

    def is_admitted(self) -> bool:
        """Return True if records made from the signals of this trip may be published."""
        return self._trusted or self._saved_state.passed

    def health_problems(self) -> list[str]:
        """Return the reason why nothing is published, as a list; the list is empty if records are
        published.
        """
        if self.is_admitted():
            return []
        return [f"the signal doctor: {', '.join(self._faults) or 'has not passed the signals yet'}"]

    def corrected_blocks(
        self, source: Generator[Block], ground: Callable[[], FloatArray]
    ) -> Generator[Block]:
        """Yield the blocks of samples of a source after correction of the known sensor errors. The
        uncorrected blocks are stored for the signal doctor.

        The function `ground` returns the speed over ground (T,) [m/s] at the samples of the block
        that the source yielded last.
        """
        if not self.is_admitted():
            log.info(
                "nothing is published until the signal doctor has passed half a minute of turns "
                "and braking"
            )
        corrector = Corrector(self.vehicle)
        direction = DrivingDirection(self.vehicle)
        with closing(source):
            for block in source:
                self._keep_block(block, ground())
                t = block.t[:, 0]
                corrected = direction.advance(t, corrector.advance(t, block.signals[:, 0]))
                yield replace(block, signals=corrected[:, None])

    def learn_rest(self) -> None:
        """Start the examination (search for sensor faults) of the last section of the trip, so that
        the calibration is also learned from this section.
        """
        self._start_examination(final=True)

    def close(self) -> None:
        """Wait at most LEAVE_S seconds for the running examination of the signals to end."""
        if self._examination is not None:
            try:
                self._examination.result(LEAVE_S)
            except TimeoutError:
                log.warning("the end of this trip is not used for learning: no time left")
        self._worker.shutdown(wait=False, cancel_futures=True)

    def _keep_block(self, block: Block, ground: FloatArray) -> None:
        now = float(block.t[-1, 0])
        if not self._blocks:
            self._part_start = float(block.t[0, 0])
            self._last_examination = self._part_start
        self._blocks.append((block.t[:, 0], block.signals[:, 0], ground))
        if now - self._part_start >= PART_S:
            self._start_examination(final=True)
        elif not self.is_admitted() and now - self._last_examination >= LOOK_S:
            self._last_examination = now
            self._start_examination(final=False)

    def _start_examination(self, *, final: bool) -> None:
        """Start, on another thread, an examination of the current section of the trip for faulty
        signals. If `final` is True, the current section ends and the next section begins.
        """
        if not self._blocks:
            return
        if not final and self._examination is not None and not self._examination.done():
            return
        part = list(self._blocks)
        if final:
            self._blocks = []
        self._examination = self._worker.submit(self._examine_part, part, final)

    def _examine_part(
        self, part: list[tuple[FloatArray, FloatArray, FloatArray]], final: bool
    ) -> None:
        t, signals, ground = (np.concatenate(columns) for columns in zip(*part, strict=True))
        try:
            diagnosis = diagnose(t, signals, self._plain, ground)
            self._faults = [f"{fault.channel} {fault.kind}" for fault in diagnosis.findings]
            if self._faults:
                log.warning("the signal doctor: %s", ", ".join(self._faults))
            estimates: DriveEstimates = {}
            if diagnosis.is_passed and final and t[-1] - t[0] >= LEAST_S:
                estimates = one_drive(t, sign_wheels(t, signals, self._plain), self._plain)
        except (ValueError, FloatingPointError, np.linalg.LinAlgError) as error:
            log.warning("a part of this trip cannot be analysed: %s", error)
            return
        if diagnosis.is_passed and not self._saved_state.passed:
            log.info(
                "the signal doctor has passed: units, signs, clocks and offsets agree with each "
                "other"
            )
        passed = diagnosis.is_passed or (self._saved_state.passed and not self._faults)
        if estimates or passed != self._saved_state.passed:
            drives = (
                [*self._saved_state.drives, estimates][-MOST_DRIVES:]
                if estimates
                else self._saved_state.drives
            )
            self._saved_state = self._saved_state.model_copy(
                update={"passed": passed, "drives": drives}
            )
            _write_state(self._path, self._saved_state)


def state_path_for(spool: Path, name: str) -> Path:
    """Return the path of the file with the stored knowledge about the car `name`. It lies next to
    the car's outbox `spool` (file of unsent batches).
    """
    return spool.with_name(f"{spool.stem}.{name}.json")


def _car_identity(vehicle: Vehicle, profile: Profile) -> str:
    text = vehicle.model_dump_json(exclude_none=True) + profile.to_json()
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _read_state(path: Path, identity: str) -> Known:
    """Return the knowledge about a car that is stored in the file `path`. Return empty knowledge if
    the file is missing or broken, or belongs to another car than `identity`.
    """
    try:
        known = Known.model_validate_json(path.read_bytes())
    except FileNotFoundError:
        return Known(of=identity)
    except (OSError, ValidationError) as error:
        log.warning(
            "%s cannot be read (%s): learning starts again", path, str(error).splitlines()[0]
        )
        return Known(of=identity)
    if known.of != identity:
        log.warning("%s belongs to another vehicle file or profile: learning starts again", path)
        return Known(of=identity)
    return known


def _write_state(path: Path, known: Known) -> None:
    """Write the stored knowledge about a car to its file, atomically."""
    try:
        write_durably(path, known.model_dump_json(indent=1) + "\n")
    except OSError as error:
        log.warning(
            "%s cannot be written (%s): what was learned from this part of the trip is lost",
            path,
            error,
        )
