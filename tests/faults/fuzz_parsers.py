"""Campaign of coverage-guided fuzzing: every parser in `tests.fuzz`, from the committed seeds.

The full form runs in rounds of ROUND_S per parser, until all parsers together have run EXECUTIONS
inputs. This takes ten minutes on an idle machine. The campaign stops after LONGEST_S at the latest.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Final

from schemas.runtime.figures import Figure
from tests.faults.bars import make_figure
from tests.faults.frame import Site
from tests.fuzz import PARSERS, Fuzzer, Result, make_keeper, seeds_of

EXECUTIONS: Final = 10_000_000
QUICK: Final = 400  # executions per parser in a quick run
ROUND_S: Final = 15.0
LONGEST_S: Final = 7200.0


def run(site: Site) -> list[Figure]:
    """Run the parsers on ten million inputs (in a quick run, some thousands), and return the
    figures.
    """
    fuzzers = {
        name: Fuzzer(parser, seeds_of(name), site.seed, make_keeper(site.folder / name))
        for name, parser in PARSERS.items()
    }
    found: dict[str, Result] = {}
    end = time.monotonic() + LONGEST_S
    while True:
        for name, fuzzer in fuzzers.items():
            found[name] = fuzzer.run(executions=QUICK) if site.quick else fuzzer.run(ROUND_S)
        executions = sum(one.executions for one in found.values())
        site.say(f"{executions} executions")
        if site.quick or executions >= EXECUTIONS or time.monotonic() > end:
            break
    for name, one in found.items():
        site.say(f"{name}: {one}")
    ran = make_figure("faults.fuzz_parsers.executions", executions)
    return [
        make_figure("faults.fuzz_parsers.crashes", sum(one.crashes for one in found.values())),
        make_figure("faults.fuzz_parsers.hangs", sum(one.hangs for one in found.values())),
        ran if site.quick else replace(ran, bar=EXECUTIONS),
        make_figure("faults.fuzz_parsers.lines", sum(one.lines for one in found.values())),
    ]
