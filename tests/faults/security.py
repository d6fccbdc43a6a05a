"""Campaign of attacks on a fleet with TLS and access list, each with the access of a vehicle, a
reader or a stranger.
"""

from __future__ import annotations

from schemas.runtime.figures import Figure
from tests.faults.attempts import ATTEMPTS
from tests.faults.bars import make_figure
from tests.faults.frame import Site
from tests.faults.ground import open_ground
from tests.secured import open_network


def run(site: Site) -> list[Figure]:
    """Run every attack on the system in one environment of router and service. The last attack
    revokes the attacker's certificate.
    """
    breaches = []
    with open_network(site.folder / "certificates") as running, open_ground(running) as found:
        for name, attempt in ATTEMPTS.items():
            if attempt(found):
                breaches.append(name)
                site.say(f"BREACH: {name}")
    return [
        make_figure("faults.security.breaches", len(breaches)),
        make_figure("faults.security.attempts", len(ATTEMPTS)),
    ]
