"""Campaign of malformed messages, weather, queries and acknowledgements through a real router, to a
service and vehicles.

Campaign `fuzz` passes its inputs directly to the engine (service without network). Here the inputs
pass through the whole system: Zenoh's threads, the bounded queue, rate limits of vehicles, handlers
of queries, and the worker (thread that processes messages). Meanwhile vehicles report through the
agent's publisher and outbox. The malformed acknowledgements cannot be decoded. Forged
acknowledgements are no part of this campaign, because certificates prevent them (see campaign
`security`).
"""

from __future__ import annotations

import random
import time
import urllib.request
from typing import Final

import zenoh

from schemas import grid, keys, wire
from schemas.config import ZenohSettings
from schemas.errors import WireError
from schemas.runtime.figures import Figure
from schemas.runtime.zenoh_session import open_session
from tests.faults.bars import make_figure
from tests.faults.census import compare_with_archive, read_journals
from tests.faults.frame import Site
from tests.faults.mutants import Mutants, changed_bytes
from tests.faults.processes import Stage, open_stage
from tests.fleet_service.examples import LATITUDE, LONGITUDE, REGION

TURN: Final = 200  # malformed messages between two queries
HONEST: Final = tuple(f"sim-{number:03}" for number in range(10))
RATE: Final = 5.0  # observations/s of each honest vehicle
# Malformed messages are sent until at least this many batches of honest vehicles have been
# acknowledged. A fast machine would otherwise end a quick run earlier.
HONEST_LEAST: Final = 10
HONEST_S: Final = 60.0
DRAIN_S: Final = 60.0
ANSWER_S: Final = 30.0
LONGEST_ENCODING: Final = 255
MAP: Final = f"{keys.ROOT}/map/**"
TILE: Final = int(grid.tile_of(grid.cell_of(LATITUDE, LONGITUDE)))
ASKED: Final = (
    MAP,
    keys.map_key(TILE),
    f"{keys.ROOT}/alert/**",
    keys.alert_key(TILE),
    f"{keys.ROOT}/**",
)


def run(site: Site) -> list[Figure]:
    """Send two hundred thousand malformed messages (in a quick run, four thousand), or more until
    enough batches of honest vehicles are acknowledged, and return the figures.
    """
    r = random.Random(site.seed)
    sent = 0
    answers = 0
    with open_stage(site.folder, metrics_port=0) as stage:
        stage.make_load(HONEST, RATE, flush_s=0.5).start()
        stage.loads[0].line_with("ready: ")
        session = open_session(ZenohSettings(connect=[stage.endpoint]))
        assert session is not None
        with session:
            mutants = Mutants(site.seed, time.time_ns())
            turns = site.choose_amount(200_000, 4_000) // TURN
            deadline = time.monotonic() + HONEST_S
            turn = 0
            while turn < turns or (
                len(read_journals(stage.journals).settled) < HONEST_LEAST
                and time.monotonic() < deadline
            ):
                mutants.now = time.time_ns()
                sent += sum(_put_message(session, *_make_message(r, mutants)) for _ in range(TURN))
                answers += _ask_query(session, r, mutants)
                if not turn % 50:
                    site.say(f"{sent} malformed, {answers} answers")
                turn += 1
            alive = stage.service.is_alive and all(part.is_alive for part in stage.loads)
            counts = _read_metrics(stage)
        stage.drain(DRAIN_S)
        code = stage.service.stop() if stage.service.is_alive else 1
        census = compare_with_archive(stage.journals, stage.archive)
        tracebacks = [
            line
            for part in (stage.service, *stage.loads)
            for line in part.read_lines()
            if "Traceback" in line
        ]
    failures = counts.get('gripmap_failures_total{work="answer"}', 0.0)
    refused = sum(
        value for name, value in counts.items() if name.startswith("gripmap_refused_messages")
    )
    site.say(f"{census}; {failures:.0f} answers failed, {len(tracebacks)} tracebacks, exit {code}")
    return [
        make_figure(
            "faults.fuzz_wire.crashes", (not alive) + (code != 0) + len(tracebacks) + failures
        ),
        make_figure("faults.fuzz_wire.honest_lost", census.lost),
        make_figure("faults.fuzz_wire.doubled", census.doubled),
        make_figure("faults.fuzz_wire.honest", census.settled),
        make_figure("faults.fuzz_wire.refused", refused),
        make_figure("faults.fuzz_wire.answered", answers),
        Figure("faults.fuzz_wire.sent", sent, "malformed messages that Zenoh let through"),
    ]


def _make_message(r: random.Random, mutants: Mutants) -> tuple[str, bytes, str]:
    """Return Zenoh key, payload and encoding of a malformed message, drawn with the random
    generator `r`.
    """
    message = mutants.make_message()
    what = r.random()
    if what < 0.02:
        return (
            keys.weather_key(REGION),
            changed_bytes(r, message.payload),
            r.choice(list(wire.ENCODING.values())),
        )
    if what < 0.04:
        return keys.ack_key(r.choice(HONEST)), _unreadable_ack(r), wire.ACK_ENCODING
    if what < 0.06:
        return (
            r.choice((keys.map_key(TILE), keys.alert_key(TILE))),
            message.payload,
            message.encoding,
        )
    return message.key, message.payload, message.encoding


def _unreadable_ack(r: random.Random) -> bytes:
    while True:
        payload = r.randbytes(r.randrange(1, 200))
        try:
            wire.decode_ack(payload)
        except WireError:
            return payload


def _put_message(session: zenoh.Session, key: str, payload: bytes, encoding: str) -> int:
    """Publish a message. Return 1, or 0 if Zenoh refuses the key or the encoding is too long: a
    longer encoding would end the sender's own session.
    """
    if len(encoding) > LONGEST_ENCODING:
        return 0
    try:
        session.put(
            key, payload, encoding=encoding, congestion_control=zenoh.CongestionControl.BLOCK
        )
    except (zenoh.ZError, ValueError):
        return 0
    return 1


def _ask_query(session: zenoh.Session, r: random.Random, mutants: Mutants) -> int:
    """Send a malformed query, drawn with the random generator `r`, with a malformed payload. Return
    the number of answers, errors not counted.
    """
    parameters = ";".join(f"{name}={value}" for name, value in mutants.make_query().items())
    payload = r.choice((None, b"", r.randbytes(300), mutants.make_message().payload))
    try:
        replies = session.get(f"{r.choice(ASKED)}?{parameters}", payload=payload, timeout=ANSWER_S)
        return sum(reply.ok is not None for reply in replies)
    except (zenoh.ZError, ValueError):
        return 0


def _read_metrics(stage: Stage) -> dict[str, float]:
    """Return the current metrics of the service under attack, by name."""
    address = stage.service.line_with("ready: ").split()[-1]
    with urllib.request.urlopen(f"{address}/metrics", timeout=30.0) as page:
        lines = [line for line in page.read().decode().splitlines() if not line.startswith("#")]
    return {line.rpartition(" ")[0]: float(line.rpartition(" ")[2]) for line in lines}
