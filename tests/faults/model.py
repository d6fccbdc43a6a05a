"""The model of acknowledgement, lease, hand-over and erasure: every state, and every rule
switched off once.
"""

from __future__ import annotations

from schemas.runtime.figures import Figure
from tests.faults.bars import figure
from tests.faults.frame import Site
from tests.faults.protocol_model import BROKEN, Rules, check


def run(site: Site) -> list[Figure]:
    """All states with equal and unlike lease times; the broken protocols must be found out."""
    checked = [
        check(Rules(), most_turn=site.of(2, 1)),
        check(Rules(lease=(6, 2)), most_turn=site.of(2, 1)),
    ]
    for one in checked:
        if one.violation is not None:
            site.say(f"{one.violation.problem}: {'; '.join(one.violation.steps)}")
    unnoticed = [
        name for name, rules in BROKEN.items() if check(rules, most_turn=1).violation is None
    ]
    site.say(f"not found out: {unnoticed}")
    return [
        figure("faults.model.violations", sum(one.violation is not None for one in checked)),
        figure("faults.model.unnoticed", len(unnoticed)),
        figure("faults.model.states_checked", sum(one.states for one in checked)),
    ]
