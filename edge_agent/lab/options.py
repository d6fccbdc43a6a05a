"""Command-line options that describe a simulated fleet. They are shared by `edge-agent fleet` and
`python -m edge_agent.lab.end_to_end`.
"""

from __future__ import annotations

import argparse


def add_simulated_fleet(parser: argparse.ArgumentParser) -> None:
    """Add the options for the scenario and for the shares of special vehicles to a parser."""
    parser.add_argument(
        "--scenario",
        default="demo",
        help="demo (default), hills, test, or hills-N, winter-N: a town drawn from seed N",
    )
    parser.add_argument(
        "--rough",
        type=float,
        default=0.0,
        help="share of vehicles with the sensor errors of real cars (default 0)",
    )
    parser.add_argument(
        "--winter",
        type=float,
        default=0.0,
        help="share of vehicles with winter tyres and stability controllers (default 0)",
    )
