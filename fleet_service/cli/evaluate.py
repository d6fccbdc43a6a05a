"""`fleet-service evaluate`: simulate fleets, and compare the service's map with the true road and
with simple rules.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Final

from schemas.errors import InputError

PARTS: Final = (
    "exact",
    "ice",
    "fleets",
    "attacks",
    "models",
    "fading",
    "third-party",
    "value",
    "situations",
    "end-to-end",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `fleet-service evaluate`."""
    parser.add_argument(
        "--out", metavar="DIR", type=Path, required=True, help="folder for figures, table and plots"
    )
    parser.add_argument(
        "--quick", action="store_true", help="one seed, as a smoke test; checks no bars"
    )
    # The second name of an option is that of earlier versions.
    way = parser.add_mutually_exclusive_group()
    way.add_argument(
        "--skip-end-to-end",
        "--skip-whole-way",
        action="store_true",
        help="omit the vehicles with real estimators",
    )
    way.add_argument(
        "--end-to-end",
        "--whole-way",
        action="store_true",
        help="only the vehicles with real estimators, in a level town and on hills",
    )
    way.add_argument(
        "--only",
        choices=PARTS,
        help="one part; "
        "exact: independence of arrival order and replay; ice: ice that appears and disappears; "
        "fleets: with and without misbehaving vehicles; attacks: malicious reports; "
        "models: fleets with other error models; fading: ageing of the belief on a dry road; "
        "third-party: vehicles of another make; value: alerts and known roads, compared with two "
        "simple rules; "
        "situations: bounds, a backlog, gentle drivers, a wet curve; "
        "end-to-end: the same as --end-to-end",
    )


def run(arguments: argparse.Namespace) -> int:
    """Run the evaluation, and print the table of figures with their targets."""
    from fleet_service.lab import campaign
    from schemas.runtime import figures

    only = campaign.END_TO_END_PART if arguments.end_to_end else arguments.only
    driven = not arguments.skip_end_to_end and only in (None, campaign.END_TO_END_PART)
    drives = campaign.drives_end_to_end(arguments.quick) if driven else {}

    def log_line(line: str) -> None:
        print(line, flush=True)

    try:
        found = campaign.run(arguments.out, arguments.quick, drives, log_line, only=only)
    except OSError as error:
        raise InputError(
            "out", f"cannot write {error.filename} ({error.strerror})", "choose another folder"
        ) from error
    print(f"\n{figures.format_table([figure for figure in found if figure.bar is not None])}\n")
    return 0 if arguments.quick or campaign.all_hold(found) else 1
