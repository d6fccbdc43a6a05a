"""Campaign on the model of acknowledgement, lease, hand-over and erasure: all states are checked,
also with each rule switched off.
"""

from __future__ import annotations

from schemas.runtime.figures import Figure
from tests.faults.bars import make_figure
from tests.faults.frame import Site
from tests.faults.protocol_model import BROKEN, Rules, explore_states


def run(site: Site) -> list[Figure]:
    """Check all states of the model of acknowledgement and takeover with equal and different lease
    times, and that the model finds each broken protocol; return the figures.
    """
    checked = [
        explore_states(Rules(), most_turn=site.choose_amount(2, 1)),
        explore_states(Rules(lease=(6, 2)), most_turn=site.choose_amount(2, 1)),
    ]
    for one in checked:
        if one.violation is not None:
            site.say(f"{one.violation.problem}: {'; '.join(one.violation.steps)}")
    unnoticed = [
        name
        for name, rules in BROKEN.items()
        if explore_states(rules, most_turn=1).violation is None
    ]
    site.say(f"not found out: {unnoticed}")
    return [
        make_figure("faults.model.violations", sum(one.violation is not None for one in checked)),
        make_figure("faults.model.unnoticed", len(unnoticed)),
        make_figure("faults.model.states_checked", sum(one.states for one in checked)),
    ]
