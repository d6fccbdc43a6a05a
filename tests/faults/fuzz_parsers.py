"""Coverage-guided fuzzing of every parser in `tests.fuzz`, from the kept seeds."""

from __future__ import annotations

from schemas.runtime.figures import Figure
from tests.faults.bars import make_figure
from tests.faults.frame import Site
from tests.fuzz import PARSERS, Fuzzer, make_keeper, seeds_of


def run(site: Site) -> list[Figure]:
    """Ten million executions, or some thousands."""
    each = site.choose_amount(10_000_000, 6_000) // len(PARSERS)
    executions = crashes = hangs = lines = 0
    for name, parser in PARSERS.items():
        found = Fuzzer(parser, seeds_of(name), site.seed, make_keeper(site.folder / name)).run(
            executions=each
        )
        site.say(f"{name}: {found}")
        executions = executions + found.executions
        crashes = crashes + found.crashes
        hangs = hangs + found.hangs
        lines = lines + found.lines
    return [
        make_figure("faults.fuzz_parsers.crashes", crashes),
        make_figure("faults.fuzz_parsers.hangs", hangs),
        make_figure("faults.fuzz_parsers.executions", executions),
        make_figure("faults.fuzz_parsers.lines", lines),
    ]
