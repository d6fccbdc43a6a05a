"""Campaign that checks the protocol model in `protocol_model.py`: acknowledgement, lease (exclusive
ownership of the archive), takeover, hand-over and erasure. The model checker visits every reachable
state up to a maximum number of leases and renewals.

The protocol with all its rules must break no invariant. Then one rule at a time is switched off
(the variants in BROKEN), for example the fence (list of the former owner's valid files), or the
limit of half a lease for acknowledgements. Each of these variants must break an invariant, which
shows that the checker can find errors.
"""

from __future__ import annotations

from schemas.runtime.figures import Figure
from tests.faults.bars import make_figure
from tests.faults.frame import Site
from tests.faults.protocol_model import BROKEN, Rules, explore_states


def run(site: Site) -> list[Figure]:
    """Check the takeover protocol (`protocol_model`) with all its rules, once with equal and once
    with different lease times of the two services. Then check each variant in BROKEN, which lacks
    one rule. Return three figures:

    - number of checks of the complete protocol that found a violation (must be 0)
    - number of variants in BROKEN in which no violation was found (must be 0)
    - number of states of the complete protocol that were visited
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
