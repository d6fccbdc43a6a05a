"""`python -m fleet_service.app.past_process ARCHIVE`: answers queries about past maps, from stdin
to stdout.
"""

from __future__ import annotations

import sys
from pathlib import Path

from fleet_service.app import UNUSED
from schemas.runtime.process import limit_memory


def main() -> int:
    """Answer queries about past maps from standard input until it ends."""
    limit_memory(*UNUSED)  # before the first import of a library that would load them: saves 40 MB
    from fleet_service.app.native_library import use_service_library

    use_service_library()
    from fleet_service.app.historical_maps import answer_all

    answer_all(Path(sys.argv[1]), sys.stdin.buffer, sys.stdout.buffer)
    return 0


if __name__ == "__main__":
    sys.exit(main())
