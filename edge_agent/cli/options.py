"""Options that several commands share. The module imports little, because it is loaded for every
help text, and help must appear fast.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from edge_agent.adaptation.memberships import Memberships
    from schemas.config import AgentConfig


def add_estimator(parser: argparse.ArgumentParser) -> None:
    """Add the options `--estimator` and `--memberships`."""
    parser.add_argument(
        "--estimator", help="name of the estimator (default: the configuration's, aco-fckf)"
    )
    parser.add_argument(
        "--memberships", type=Path, metavar="FILE", help="fuzzy sets written by edge-agent tune"
    )


def memberships_of(args: argparse.Namespace) -> Memberships | None:
    """Return the fuzzy sets given by `--memberships`; None if the option was not given."""
    from edge_agent.app.tuned_memberships import load_tuned

    return load_tuned(args.memberships).memberships if args.memberships else None


def add_connection(parser: argparse.ArgumentParser, purpose: str = "") -> None:
    """Add the options `--config` and `--connect`; `purpose` ends both help texts."""
    parser.add_argument("--config", type=Path, help=f"agent configuration (JSON){purpose}")
    parser.add_argument(
        "--connect",
        metavar="ENDPOINT",
        help=f"router, instead of the configuration's, e.g. tcp/127.0.0.1:7447{purpose}",
    )


def config_of(args: argparse.Namespace) -> AgentConfig:
    """Return the agent's configuration given by `--config`, with the router of `--connect`.

    Raises:
        InputError: the file cannot be read, or a setting is unknown or out of range.
    """
    from schemas.config import AgentConfig, load_config

    config = load_config(args.config, AgentConfig)
    return config.model_copy(update={"zenoh": config.zenoh.with_endpoint(args.connect)})


def add_json(parser: argparse.ArgumentParser, content: str) -> None:
    """Add the option `--json` for machine-readable output."""
    parser.add_argument("--json", action="store_true", help=f"print {content} as JSON")


def print_list(entries: Mapping[str, str], *, as_json: bool) -> None:
    """Print names with a one-line description each, as text or as one JSON object."""
    if as_json:
        print(json.dumps(dict(entries)))
    else:
        for name, about in entries.items():
            print(f"{name:<24} {about}")
