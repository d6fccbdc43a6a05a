"""`python -m tests.faults.rogue`: Zenoh session of an attacker in a separate process, for attacks
that may crash their sender. The session can be a client, a peer or a router.

The process works in these steps:

1. It reads one line of JSON: Zenoh settings, session name, keys to subscribe to, and messages.
2. It publishes the messages and prints a line.
3. It waits for a second line of input, and queries the map. When the answer arrives, all earlier
   messages have arrived too.
4. It prints the keys of all messages that it has received.
5. It ends without closing the session, because closing a session in router mode may abort the
   process.
"""

from __future__ import annotations

import json
import os
import sys

import zenoh

from schemas import keys
from schemas.config import ZenohSettings
from schemas.runtime.zenoh_session import configuration


def main() -> None:
    """Run the attacker's session that the line on standard input describes."""
    task = json.loads(sys.stdin.readline())
    received: list[str] = []
    session = zenoh.open(
        configuration(ZenohSettings.model_validate(task["settings"]), task["name"])
    )
    hearing = [
        session.declare_subscriber(one, lambda s: received.append(str(s.key_expr)))
        for one in task["hear"]
    ]
    list(session.get(f"{keys.ROOT}/map/**"))
    for place in task["put"]:
        session.put(place, task["payload"])
    list(session.get(f"{keys.ROOT}/map/**"))
    print(len(hearing), flush=True)
    sys.stdin.readline()
    list(session.get(f"{keys.ROOT}/map/**"))
    print(json.dumps(received), flush=True)
    os._exit(0)


if __name__ == "__main__":
    main()
