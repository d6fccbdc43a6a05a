"""`python -m fleet_service.app.erasing_process ARCHIVE`: carries out one erasure for a service,
described on stdin.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from fleet_service.app import UNUSED
from schemas.errors import InputError
from schemas.runtime.process import limit_memory


def main() -> int:
    """Carry out an erasure of archived data, and print the result as JSON."""
    limit_memory(*UNUSED)
    from fleet_service.app.erasing import run_erasure_process

    try:
        print(json.dumps(run_erasure_process(Path(sys.argv[1]), json.load(sys.stdin))))
    except (InputError, OSError) as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
