"""Branch coverage of the packages by the tests that take seconds, `lab/` apart.

    python -m tests.branch_coverage DATA

DATA is the combined data file of `coverage`. `make coverage` runs the tests with tracing and then
this module. It writes `.evaluation/coverage/figures.json` and ends with 1 if a package is below its
target.
"""

from __future__ import annotations

import argparse
import io
import sys
from pathlib import Path
from typing import Final

from coverage import Coverage

from schemas.runtime import figures
from schemas.runtime.figures import Figure
from tests.structure import ROOT

PACKAGES: Final = ("edge_agent", "fleet_service", "schemas")
TARGET_PERCENT: Final = 90.0  # [%] of statements and branches
OUTPUT_FILE: Final = ROOT / ".evaluation" / "coverage" / "figures.json"


def measure_coverage(data_file: Path) -> list[Figure]:
    """Return the share of statements and branches [%] that the tests ran, one figure per package.

    `data_file` is the data file of `coverage`, which must contain the runs of all tests.
    """
    data_of_tests = Coverage(data_file=data_file)
    data_of_tests.load()
    return [
        Figure(
            f"coverage.branches.{package}",
            data_of_tests.report(include=[str(ROOT / package / "*")], file=io.StringIO()),
            "%",
            TARGET_PERCENT,
            "more",
        )
        for package in PACKAGES
    ]


def main(command_line: list[str]) -> int:
    """Print and write the coverage of the packages; return 1 if one misses its target, else 0."""
    argument_parser = argparse.ArgumentParser(prog="tests.branch_coverage")
    argument_parser.add_argument("data", type=Path, help="combined data file of `coverage`")
    measured_figures = measure_coverage(argument_parser.parse_args(command_line).data)
    figures.write_figures(OUTPUT_FILE, "coverage", [], measured_figures)
    print(figures.format_table(measured_figures))
    return 0 if all(figure.holds for figure in measured_figures) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
