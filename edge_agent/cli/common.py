"""Functions that several commands share: check of vehicle names, and check of signals by the signal
doctor (search for faulty sensors).
"""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from schemas.config import NAME_PATTERN
from schemas.errors import InputError

if TYPE_CHECKING:
    from edge_agent.inputs.doctor.diagnosis import Diagnosis


def checked_name(name: str) -> str:
    """Return the name if it is a valid vehicle name, that is, if it may be part of a Zenoh key.

    Raises:
        InputError: the name is invalid.
    """
    if not re.fullmatch(NAME_PATTERN, name):
        raise InputError(
            "name",
            f"{name!r} is not a vehicle name",
            "give --name, 3 to 63 of a-z, 0-9 and -, a letter first",
        )
    return name


def require_valid_signals(diagnosis: Diagnosis) -> None:
    """Raise an error unless the signals of a log passed the signal doctor (automatic check).

    Raises:
        InputError: the signal doctor found a fault, or could not decide.
    """
    from edge_agent.inputs.doctor.report import report_lines

    if not diagnosis.is_passed:
        print(
            "\n".join(line for line in report_lines(diagnosis) if not line.startswith("sound")),
            file=sys.stderr,
        )
        fix = (
            "correct its profile (edge-agent check --fix)"
            if diagnosis.findings
            else "drive half a minute with turns and some braking"
        )
        raise InputError(
            "log", "did not pass the signal doctor", f"{fix}, or publish it unchanged with --trust"
        )


def warn_about_faults(diagnosis: Diagnosis, log: Path) -> list[str]:
    """Print on stderr the faults that the signal doctor found in a log. Return notes about these
    faults, which the caller prints after the estimates.
    """
    found = diagnosis.findings
    for fault in found:
        print(f"warning: {log}: {fault}", file=sys.stderr)
    if found:
        print(
            "warning: the estimates below are invalid until this is corrected; run edge-agent "
            "check",
            file=sys.stderr,
        )
    notes = []
    if found:
        notes.append(
            f"note: the signal doctor did not pass {log}; replay --publish would refuse it"
        )
    elif not diagnosis.is_passed:
        channels = ", ".join(diagnosis.unknown)
        notes.append(f"note: the signal doctor did not pass {log}: it cannot judge {channels}")
    return notes
