"""`fleet-service certs`: create the certificates of everyone on the enrolment list, and print the
next steps.
"""

from __future__ import annotations

import argparse
from datetime import UTC, datetime
from pathlib import Path

from schemas.errors import InputError
from schemas.runtime.installing import install_command

LONGEST_DAYS = 36525.0  # a century; later dates may not be representable
# Largest number of names that are revoked without a question. An incomplete list must not revoke a
# whole fleet.
ASKED = 3
SHOWN = 8  # number of names shown of each kind


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `fleet-service certs`."""
    parser.add_argument(
        "--fleet",
        metavar="FILE",
        type=Path,
        required=True,
        help="enrolment file (JSON): everyone who takes part, by role",
    )
    parser.add_argument(
        "--out",
        metavar="DIR",
        type=Path,
        required=True,
        help="folder of the certificates; run again to renew and to revoke",
    )
    parser.add_argument(
        "--at",
        metavar="DIR",
        type=Path,
        help="folder in which the routers find the files (default: --out)",
    )
    parser.add_argument(
        "--days", type=float, default=365.0, help="validity of a certificate in days (default 365)"
    )
    parser.add_argument(
        "--ca-days",
        type=float,
        default=3650.0,
        help="validity of a new authority in days (default 3650)",
    )
    parser.add_argument(
        "--renew-days",
        type=float,
        default=30.0,
        help="renew certificates that end within this many days (default 30)",
    )
    parser.add_argument(
        "--revoke",
        metavar="N",
        type=int,
        help=f"confirm that N certificates are revoked; required for more than {ASKED}",
    )
    parser.add_argument(
        "--dry-run", action="store_true", help="only print the names that would be revoked"
    )
    parser.add_argument(
        "--ca",
        choices=("next", "switch", "drop"),
        help="next step of the change to another authority",
    )


def run(arguments: argparse.Namespace) -> int:
    """Check the options, then create missing certificates and router configurations."""
    from fleet_service.enrolment.fleet import Enrolment
    from schemas.config import load_config

    days = (arguments.days, arguments.ca_days, arguments.renew_days)
    out = arguments.out
    for name, value in zip(("days", "ca-days", "renew-days"), days, strict=True):
        if not 0.0 < value <= LONGEST_DAYS:
            raise InputError(
                name,
                f"{value:g} is not a valid duration",
                f"give more than 0 and at most {LONGEST_DAYS:g} days",
            )
    if days[2] >= days[0]:
        raise InputError(
            "renew-days", f"is not less than the {days[0]:g} days of a certificate", "give fewer"
        )
    fleet = load_config(arguments.fleet, Enrolment, "fleet")
    try:
        from fleet_service.enrolment.enrol import Registry, ValidityPeriods
    except ImportError as error:
        raise InputError(
            "certs", "the package cryptography is missing", install_command("certs")
        ) from error
    try:
        registry = Registry(out, ValidityPeriods(*days), datetime.now(UTC), arguments.at)
        leaving = registry.list_leaving(fleet)
        if arguments.dry_run:
            print(f"would revoke {len(leaving)}: {', '.join(leaving) or 'none'}")
            return 0
        if len(leaving) > (ASKED if arguments.revoke is None else arguments.revoke):
            shown = ", ".join(leaving[:SHOWN]) + (" …" if len(leaving) > SHOWN else "")
            fix = f"put them back on the list, or add --revoke {len(leaving)}"
            raise InputError(
                "fleet",
                f"{len(leaving)} names with a certificate are not on the list: {shown}",
                fix,
            )
        done = registry.enrol(fleet, arguments.ca)
    except OSError as error:
        problem = f"cannot write {error.filename or out} ({error.strerror})"
        raise InputError("out", problem, "give a folder that you may write to") from error
    for word, names in (("issued", done.issued), ("kept", done.kept), ("revoked", done.revoked)):
        if names:
            more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
            print(f"{word} {len(names)}: {', '.join(names[:SHOWN])}{more}")
    print(f"routers: restart {', '.join(fleet.routers)} one at a time, each with its file in {out}")
    return 0
