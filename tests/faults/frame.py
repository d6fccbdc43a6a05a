"""The frame of the fault campaigns: a plain list of them, run one after the other, each in a folder
of its own.

A campaign is a function from a `Site` to figures. One with a bar is made by `bars.figure(name,
value)`; a figure that only describes the load (kills, rates) is a `Figure` without a bar. To add
one: write `tests/faults/NAME.py` with `def run(site: Site) -> list[Figure]`, and name it in
`campaigns.py` with the figures that it must give.

`quick` is for `make check`: seconds, the same mechanism, smaller numbers. A required figure that is
missing fails. A campaign that raises ends the run with its traceback, because its measurements are
unknown.
"""

from __future__ import annotations

import os
import shutil
import signal
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple, NoReturn

from schemas.runtime import figures
from schemas.runtime.figures import Figure
from schemas.runtime.process import force_exit
from tests.faults.bars import make_figure

RAISED: Final = 2  # exit code; 1: a bar does not hold


@dataclass(frozen=True)
class Site:
    """Where and how a campaign runs.

    Attributes:
        folder: empty, its own; kept for inspection when a bar does not hold.
        quick: seconds instead of minutes.
        seed: of everything random.
        say: takes a line of progress.
    """

    folder: Path
    quick: bool
    seed: int
    say: Callable[[str], None]

    def choose_amount(self, full: int, quick: int) -> int:
        """Return one of two values, depending on whether the run is quick."""
        return quick if self.quick else full


class Campaign(NamedTuple):
    """A campaign by name, and the figures that it owes; in a quick run it may be left out."""

    name: str
    run: Callable[[Site], list[Figure]]
    owes: tuple[str, ...]
    in_quick: bool = True


def run_campaigns(
    campaigns: Sequence[Campaign], out: Path, title: str, quick: bool, seed: int
) -> list[Figure]:
    """Run them, with progress on stderr; writes `out/figures.json` and `out/figures.md`, returns
    all figures.
    """
    found: list[Figure] = []
    out.mkdir(parents=True, exist_ok=True)
    for campaign in campaigns:
        found += _run_campaign(campaign, out, quick, seed)
        figures.write(out / "figures.json", title, [seed], found)
        (out / "figures.md").write_text(figures.markdown(found) + "\n")
    return found


def run_and_exit(run: Callable[[], int]) -> NoReturn:
    """Run campaigns and end the process with their exit code; with RAISED and a traceback at once
    if one raises.

    A session that is still open holds the interpreter's end up for minutes, and processes that were
    started would stay.
    """
    try:
        code = run()
    except Exception:  # noqa: BLE001 whatever it is, it is told and ends the run
        traceback.print_exc()
        for children in Path("/proc/self/task").glob("*/children"):
            for child in children.read_text().split():
                with suppress(ProcessLookupError):
                    os.kill(int(child), signal.SIGKILL)
        code = RAISED
    force_exit(code)


def _run_campaign(campaign: Campaign, out: Path, quick: bool, seed: int) -> list[Figure]:
    folder = out / campaign.name
    began = time.monotonic()
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()

    def print_progress(line: str) -> None:
        print(
            f"{time.monotonic() - began:7.1f} s  {campaign.name}: {line}",
            file=sys.stderr,
            flush=True,
        )

    print_progress("begins")
    found = campaign.run(Site(folder, quick, seed, print_progress))
    missing = [name for name in campaign.owes if name not in {one.name for one in found}]
    found += [make_figure(name, float("nan")) for name in missing]
    failed = [one.name for one in found if not one.holds]
    print_progress(f"DOES NOT HOLD: {', '.join(failed)}; see {folder}" if failed else "holds")
    if not failed:
        shutil.rmtree(folder)
    return found
