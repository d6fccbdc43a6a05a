"""Benchmark part that tests the map clients in other programming languages with a router and a
service.
"""

from __future__ import annotations

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from schemas.runtime.figures import Figure
from tests.deploy.clients import PLACES, build_client, missing_tool, run_client, served_map


def measure_clients(folder: Path, _quick: bool) -> list[Figure]:
    """Build and run the map client in each programming language. Print the reason for each client
    that is left out or fails.
    """
    tested = 0
    failed = 0
    with TemporaryDirectory() as work, served_map(Path(work)) as endpoint:
        for language in PLACES:
            reason = missing_tool(language)
            if reason:
                print(f"the client in {language} is left out: {reason}", file=sys.stderr)
                continue
            tested += 1
            try:
                command = build_client(language, folder / "clients" / language)
                found = run_client(command, language, endpoint)
                failed += found["cells"] != 1
            except RuntimeError as error:
                failed += 1
                print(f"the client in {language} failed: {error}", file=sys.stderr)
    return [
        Figure(
            "clients.failed",
            float(failed),
            "clients that were not acknowledged, warned and given a tile",
            0.0,
        ),
        Figure("clients.tested", float(tested), "clients, in C and in TypeScript", 1.0, "more"),
    ]
