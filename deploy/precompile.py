"""`python -m deploy.precompile`: compile what service, agent and simulated vehicle need, once on this machine.

`make setup` ends with it, so that the first start of anything does not wait. What cannot be compiled here is
compiled at the first start, which says so.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path

SERVICE = "from fleet_service.app.precompile import warm_up; warm_up()"
AGENT = "import sys; from edge_agent.cli import main; sys.exit(main())"
DRIVE = ("straight", "--duration", "1", "--seed", "0", "--out", "drive.parquet", "--vehicle-out", "car.json")
ESTIMATE = ("drive.parquet", "--vehicle", "car.json", "--out", "estimates.parquet")


def main() -> int:
    """Compile, both halves side by side; 0 whatever comes of it."""
    began = time.monotonic()
    print("compiling kernels, once on this machine", flush=True)
    with tempfile.TemporaryDirectory() as folder, (Path(folder) / "log").open("w+") as log:
        service = subprocess.Popen([sys.executable, "-c", SERVICE], stdout=log, stderr=log)
        for command in (("simulate", *DRIVE), ("replay", *ESTIMATE)):
            subprocess.run([sys.executable, "-c", AGENT, *command], cwd=folder, stdout=log, stderr=log, check=False)
        service.wait()
        log.seek(0)
        said = [line for line in log if "error" in line.lower()]
    print(f"compiled in {time.monotonic() - began:.0f} s", *said, sep="\n", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
