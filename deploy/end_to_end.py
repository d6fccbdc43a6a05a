"""Former name of the command `python -m edge_agent.lab.end_to_end`, for existing scripts."""

from __future__ import annotations

import sys

from edge_agent.lab.end_to_end import main

if __name__ == "__main__":
    sys.exit(main())
