"""Example: estimate friction on a simulated drive with two estimators, compare them with the true
values, and make a data frame and a plot.

python deploy/examples/first_estimate.py FOLDER
"""

from __future__ import annotations

import sys
from pathlib import Path

import pyarrow.parquet as pq

import edge_agent


def main(folder: Path) -> None:
    """Simulate a drive, estimate friction with two estimators, and plot the result."""
    folder.mkdir(parents=True, exist_ok=True)
    truth, vehicle = edge_agent.simulate_manoeuvre("double-lane-change", mu=0.5, seed=1)
    # Your own log has the same columns, in SI units.
    pq.write_table(truth, folder / "drive.parquet")
    log = edge_agent.read_log(folder / "drive.parquet")
    found = {name: edge_agent.estimate(log, vehicle, name) for name in ("ckf", "sr-ukf")}
    frame = found["ckf"].to_pandas()
    print(
        frame[["t", "vx", "mu", "mu_lower", "mu_upper", "mu_utilised"]]
        .iloc[::100]
        .round(2)
        .to_string(index=False)
    )
    title = "double lane change at 22 m/s, μ .5, sedan, seed 1"
    edge_agent.plot(found, truth=truth, title=title).savefig(folder / "first.svg")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "try/first"))
