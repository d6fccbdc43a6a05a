"""`python -m tests.faults [--quick] [--only NAME …] [--out DIR] [--seed N]`: run the fault
campaigns and print the table of their figures.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from schemas.runtime import figures
from tests.faults.campaigns import CAMPAIGNS
from tests.faults.frame import run_and_exit, run_campaigns


def main() -> int:
    """Run the chosen fault campaigns (tests under failures). Return 0 if every figure meets its bar
    (target), otherwise 1.
    """
    names = [campaign.name for campaign in CAMPAIGNS]
    parser = argparse.ArgumentParser(
        prog="tests.faults", description="Fault campaigns; see tests/faults/README.md."
    )
    parser.add_argument("--quick", action="store_true", help="three minutes, smaller numbers")
    parser.add_argument("--only", nargs="+", choices=names, help="these campaigns alone")
    parser.add_argument(
        "--out", type=Path, default=Path(".faults"), help="figures and left-overs (default .faults)"
    )
    parser.add_argument("--seed", type=int, default=0, help="of everything random (default 0)")
    args = parser.parse_args()
    chosen = [
        c for c in CAMPAIGNS if (c.name in args.only if args.only else c.in_quick or not args.quick)
    ]
    title = "faults-quick" if args.quick else "faults"
    if args.only:
        title += f" --only {' '.join(args.only)}"
    found = run_campaigns(chosen, args.out, title, args.quick, args.seed)
    print(figures.format_table(found))
    return 0 if all(figure.holds for figure in found) else 1


if __name__ == "__main__":
    run_and_exit(main)
