"""Framework of the fault campaigns: they run one after the other, each in its own folder.

A campaign is a function from a `Site` to figures. `bars.make_figure(name, value)` makes a figure
with a bar (target). A figure that only describes the load (kills, rates) is a `Figure` without a
bar. To add a campaign, write `tests/faults/NAME.py` with `def run(site: Site) -> list[Figure]`, and
add its name to `campaigns.py` with the figures that it must return.

`make check` runs the campaigns in their quick form, which takes seconds: the mechanism is the same,
but the numbers are smaller. A missing required figure is a failure. If a campaign raises an error,
the run ends with its traceback, because its measurements are unknown.
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

RAISED: Final = 2  # exit code after an exception; 1 means that a target was missed


@dataclass(frozen=True)
class Site:
    """Environment of a campaign.

    Attributes:
        folder: empty folder of this campaign; the framework does not delete it if a figure misses
            its target.
        quick: True for a run of seconds instead of minutes.
        seed: seed of all random numbers.
        say: function that prints a line of progress.
    """

    folder: Path
    quick: bool
    seed: int
    say: Callable[[str], None]

    def choose_amount(self, full: int, quick: int) -> int:
        """Return the amount (for example a number of messages or a time) for this run of the
        campaign: `quick` in a quick run, otherwise `full`.
        """
        return quick if self.quick else full


class Campaign(NamedTuple):
    """Campaign, given by its name, its function, and the names of the figures that the function
    must return (`owes`). A figure can be marked as absent in quick runs.
    """

    name: str
    run: Callable[[Site], list[Figure]]
    owes: tuple[str, ...]
    in_quick: bool = True


def run_campaigns(
    campaigns: Sequence[Campaign], out: Path, title: str, quick: bool, seed: int
) -> list[Figure]:
    """Run the given fault campaigns with progress on stderr, write `out/figures.json` and
    `out/figures.md`, and return all figures.
    """
    found: list[Figure] = []
    out.mkdir(parents=True, exist_ok=True)
    for campaign in campaigns:
        found += _run_campaign(campaign, out, quick, seed)
        figures.write_figures(out / "figures.json", title, [seed], found)
        (out / "figures.md").write_text(figures.format_table(found) + "\n")
    return found


def run_and_exit(run: Callable[[], int]) -> NoReturn:
    """Run fault campaigns and end the process with their exit code. If a campaign raises, print the
    traceback and exit at once with RAISED.

    The process ends without interpreter teardown. Otherwise an open session would delay its end for
    minutes, and started processes would remain.
    """
    try:
        code = run()
    except Exception:  # noqa: BLE001 any exception is printed and ends the run
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
