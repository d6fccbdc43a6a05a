"""Attacks on a fleet secured by TLS and an access list. Each returns False if the attack fails."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import zenoh

from deploy.router import open_router
from fleet_service.enrolment import authority as ca
from fleet_service.enrolment.access import PRIVATE_BYTES
from fleet_service.enrolment.enrol import Registry, ValidityPeriods
from fleet_service.enrolment.fleet import Enrolment
from schemas import keys, wire
from schemas.config import ZenohSettings
from schemas.errors import InputError
from schemas.runtime.zenoh_session import configuration
from tests.faults.ground import HONEST, ROGUE, Ground, Listener
from tests.fleet_service.examples import REGION, TILE, batch, key
from tests.secured import (
    READER,
    ROUTERS,
    SERVICE,
    WEATHER,
    free_endpoint,
    make_enrolment,
    open_registry,
    settings,
)
from tests.waiting import until

Attempt = Callable[[Ground], bool]
ATTEMPTS: dict[str, Attempt] = {}
SECRET = b"what only the service may hear"
ALL_OBSERVATIONS = f"{keys.ROOT}/obs/**"


def register_attempt(function: Attempt) -> Attempt:
    """Add an attack to the table ATTEMPTS under its function name."""
    ATTEMPTS[function.__name__] = function
    return function


def can_open(ground: Ground, name: str, router: str = ROUTERS[1], **changed: object) -> bool:
    """Return True if the router accepts a session of the enrolled participant `name`. The TLS
    settings `changed` replace those of this participant, for example its certificate.
    """
    try:
        with ground.network.open_session(name, router, **changed):
            return True
    except zenoh.ZError:
        return False


def issue_certificate(
    ground: Ground, name: str, folder: Path, *, days_ago: float = 0.0, days: float = 5.0
) -> dict[str, Any]:
    """Issue a certificate with the fleet's own authority, and return TLS settings that use it."""
    authority = ca.read_pair(ground.folder / "authority" / "ca")
    assert authority is not None
    folder.mkdir(exist_ok=True)
    ca.issue_certificate(
        authority, name, [], days, datetime.now(UTC) - timedelta(days=days_ago)
    ).write(folder / "it")
    return {
        "connect_certificate": str(folder / "it.pem"),
        "connect_private_key": str(folder / "it.key"),
    }


def make_stranger(ground: Ground) -> Path:
    """Create a foreign authority that certifies the fleet's names, and return its folder."""
    folder = ground.folder / "stranger"
    open_registry(folder).enrol(make_enrolment())
    return folder


@register_attempt
def certificate_of_another_authority(ground: Ground) -> bool:
    folder = make_stranger(ground)
    certificate = str(folder / "shard-0.pem")
    private = str(folder / "shard-0.key")
    return can_open(ground, SERVICE, connect_certificate=certificate, connect_private_key=private)


@register_attempt
def no_certificate(ground: Ground) -> bool:
    return can_open(
        ground, ROGUE, connect_certificate=None, connect_private_key=None, enable_mtls=False
    )


@register_attempt
def expired_certificate(ground: Ground) -> bool:
    return can_open(
        ground, ROGUE, **issue_certificate(ground, ROGUE, ground.folder / "expired", days_ago=10.0)
    )


@register_attempt
def certificate_that_is_not_good_yet(ground: Ground) -> bool:
    return can_open(
        ground, ROGUE, **issue_certificate(ground, ROGUE, ground.folder / "early", days_ago=-1.0)
    )


@register_attempt
def certificate_without_its_key(ground: Ground) -> bool:
    return can_open(ground, ROGUE, connect_certificate=str(ground.folder / f"{HONEST}.pem"))


@register_attempt
def plain_tcp(ground: Ground) -> bool:
    address = ground.network.endpoints[ROUTERS[0]].partition("/")[2]
    try:
        with zenoh.open(configuration(ZenohSettings(connect=[f"tcp/{address}"]))):
            return True
    except zenoh.ZError:
        return False


def can_lure_vehicle(ground: Ground, folder: Path, name: str) -> bool:
    """Return True if a vehicle accepts a false router whose certificate is `folder`/`name`.pem."""
    tls = {
        "root_ca_certificate": str(folder / "trust.pem"),
        "listen_certificate": str(folder / f"{name}.pem"),
        "listen_private_key": str(folder / f"{name}.key"),
    }
    file = ground.folder / "false-router.json5"
    file.write_text(
        json.dumps(
            {
                "mode": "router",
                "scouting": {"delay": 0, "multicast": {"enabled": False}},
                "transport": {"link": {"tls": tls}},
            }
        )
    )
    router, endpoints = open_router(file, free_endpoint(ground.network.protocol))
    with router:
        try:
            with zenoh.open(configuration(settings(endpoints[0], ground.folder), HONEST)):
                return True
        except zenoh.ZError:
            return False


@register_attempt
def false_router_of_another_authority(ground: Ground) -> bool:
    return can_lure_vehicle(ground, make_stranger(ground), ROUTERS[0])


@register_attempt
def false_router_with_the_certificate_of_a_vehicle(ground: Ground) -> bool:
    return can_lure_vehicle(ground, ground.folder, ROGUE)


def put_by(ground: Ground, session: zenoh.Session, *expressions: str) -> bool:
    """Publish in `session` on the keys `expressions`; return True if any listener receives it."""
    for expression in expressions:
        session.put(expression, SECRET + expression.encode())
    ground.await_effects(session)
    return any(
        listener.has_payload(SECRET) for listener in (ground.monitor, ground.reader, ground.honest)
    )


def list_foreign_keys(name: str) -> list[str]:
    """Return Zenoh keys on which the vehicle `name` may not publish."""
    other = HONEST if name != HONEST else ROGUE
    return [
        key(other),
        keys.state_key(REGION, other),
        keys.ack_key(other),
        keys.ack_key(name),
        keys.map_key(TILE),
        keys.alert_key(TILE),
        keys.weather_key(REGION),
        keys.alive_key(name),
        keys.shard_key(name),
        f"{keys.ROOT}/obs/**",
        f"{keys.ROOT}/obs/*/*/*/*",
        f"{keys.ROOT}/*/*/*/*/{name}",
        f"{keys.ROOT}/**/{name}",
        f"{keys.ROOT}/obs/0/{name}",
        f"{keys.ROOT}/obs/0/1/2/3/{name}",
        f"{keys.ROOT}/obs/0123/012/012/sim$*",
        f"{keys.ROOT}/obs/0123/012/012/{name}/{name}",
        "gripmap/v2/obs/0123/012/012/" + name,
    ]


@register_attempt
def vehicle_puts_where_it_may_not(ground: Ground) -> bool:
    return put_by(ground, ground.open_session(ROGUE, ROUTERS[1]), *list_foreign_keys(ROGUE))


@register_attempt
def reader_puts(ground: Ground) -> bool:
    return put_by(
        ground,
        ground.open_session(READER, ROUTERS[1]),
        *list_foreign_keys(HONEST),
        key(READER),
        keys.ack_key(READER),
    )


@register_attempt
def sender_of_weather_puts_something_else(ground: Ground) -> bool:
    session = ground.open_session(WEATHER, ROUTERS[1])
    session.put(keys.weather_key(REGION), b"rain")
    others = [place for place in list_foreign_keys(HONEST) if place != keys.weather_key(REGION)]
    through = put_by(ground, session, *others, key(HONEST))
    return through or not ground.monitor.has_payload(b"rain")


@register_attempt
def declared_publisher_on_another_key(ground: Ground) -> bool:
    session = ground.open_session(ROGUE, ROUTERS[1])
    for place in (key(HONEST), keys.map_key(TILE), f"{keys.ROOT}/obs/**"):
        session.declare_publisher(place).put(SECRET)
    ground.await_effects(session)
    return ground.monitor.has_payload(SECRET)


@register_attempt
def wildcard_put_on_ones_own_name(ground: Ground) -> bool:
    session = ground.open_session(ROGUE, ROUTERS[1])
    ground.await_judgement()  # otherwise refusals of an earlier attack would count for this one
    before = ground.admitted_count
    refused = ground.service.engine.counts.refused["key"]
    payload = wire.encode(batch(ROGUE, 1, 0, [0.1]))
    session.put(
        f"{keys.ROOT}/obs/*/*/*/{ROGUE}", payload, encoding=wire.ENCODING[wire.Kind.OBSERVATION]
    )
    ground.drive(session, ROGUE)
    return (
        ground.admitted_count != before + 1
        or ground.service.engine.counts.refused["key"] != refused + 1
    )


@register_attempt
def another_name_within_ones_own_key(ground: Ground) -> bool:
    session = ground.open_session(ROGUE, ROUTERS[1])
    ground.await_judgement()
    before = ground.admitted_count
    payload = wire.encode(batch(HONEST, 10**6, 0, [0.1]))
    session.put(key(ROGUE), payload, encoding=wire.ENCODING[wire.Kind.OBSERVATION])
    ground.drive(session, ROGUE)
    return ground.admitted_count != before + 1


@register_attempt
def delete(ground: Ground) -> bool:
    session = ground.open_session(ROGUE, ROUTERS[1])
    for place in (
        key(HONEST),
        key(ROGUE),
        keys.map_key(TILE),
        f"{keys.ROOT}/**",
        keys.ack_key(HONEST),
    ):
        session.delete(place)
    ground.await_effects(session)
    return not all(
        put
        for one in (ground.monitor, ground.reader, ground.honest)
        for _, put, _ in list(one.received)
    )


@register_attempt
def spoofed_reply(ground: Ground) -> bool:
    session = ground.open_session(ROGUE, ROUTERS[1])

    def reply_falsely(query: zenoh.Query) -> None:
        with query:
            query.reply(keys.map_key(TILE), SECRET)

    places = (f"{keys.ROOT}/map/**", keys.map_key(TILE))
    lying = [session.declare_queryable(place, reply_falsely, complete=True) for place in places]
    ground.await_effects(session)
    asked: Any = ground.reader.session.get(
        f"{keys.ROOT}/map/**",
        target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE,
    )
    through = any(reply.ok is not None and reply.ok.payload.to_bytes() == SECRET for reply in asked)
    for queryable in lying:
        queryable.undeclare()
    return through


def can_overhear(ground: Ground, session: zenoh.Session) -> bool:
    """Return True if `session` receives anything but the map when another vehicle reports."""
    listener = Listener(
        session,
        (
            f"{keys.ROOT}/map/**",
            ALL_OBSERVATIONS,
            f"{keys.ROOT}/state/**",
            keys.ack_key(HONEST),
            f"{keys.ROOT}/ack/*",
            key(HONEST),
            "**",
            "gripmap/**",
            f"{keys.ROOT}/*/**",
        ),
    )
    ground.await_effects(session)
    ground.drive()
    ground.await_effects(session, listener)
    return not all(name.startswith(f"{keys.ROOT}/map/") for name, _, _ in listener.received)


@register_attempt
def vehicle_overhears(ground: Ground) -> bool:
    return can_overhear(ground, ground.open_session(ROGUE, ROUTERS[1]))


@register_attempt
def reader_overhears(ground: Ground) -> bool:
    return can_overhear(ground, ground.open_session(READER, ROUTERS[1]))


@register_attempt
def foreign_liveliness_token(ground: Ground) -> bool:
    session = ground.open_session(ROGUE, ROUTERS[1])
    false = keys.ServiceToken("1202/310/*", ROGUE, "1f").key
    foreign = (keys.alive_key(HONEST), keys.shard_key(ROGUE), f"{keys.ROOT}/alive/{ROGUE}/more")
    places = (*foreign, false, keys.alive_key(ROGUE))
    tokens = [session.liveliness().declare_token(place) for place in places]

    def list_tokens() -> list[str]:
        replies = ground.monitor.session.liveliness().get(f"{keys.ROOT}/**")
        return sorted(str(reply.ok.key_expr) for reply in replies if reply.ok)

    until(lambda: keys.alive_key(ROGUE) in list_tokens())  # the rogue's own token arrives last
    through = list_tokens()
    for token in tokens:
        token.undeclare()
    own = {keys.alive_key(ROGUE), keys.shard_key(SERVICE)}
    return {key for key in through if f"/{SERVICE}/" not in key} != own


@register_attempt
def who_is_alive_is_told_to_a_vehicle(ground: Ground) -> bool:
    token = ground.honest.session.liveliness().declare_token(keys.alive_key(HONEST))
    asked = f"{keys.ROOT}/alive/*"
    until(lambda: any(reply.ok for reply in ground.monitor.session.liveliness().get(asked)))
    rogue = ground.open_session(ROGUE, ROUTERS[1])
    is_visible = any(reply.ok for reply in rogue.liveliness().get(asked))
    token.undeclare()
    return is_visible


def as_router(ground: Ground, mode: str) -> bool:
    """Return True if the attacker can connect as a router or peer, which may forward messages."""
    given = settings(ground.network.endpoints[ROUTERS[1]], ground.folder)
    given = given.model_copy(
        update={"config": {**given.config, "mode": mode, "listen/endpoints": []}}
    )
    task = {
        "settings": given.model_dump(),
        "name": ROGUE,
        "hear": [f"{keys.ROOT}/map/**", ALL_OBSERVATIONS, f"{keys.ROOT}/ack/**"],
        "put": list_foreign_keys(ROGUE),
        "payload": SECRET.decode(),
    }
    command = [sys.executable, "-m", "tests.faults.rogue"]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdin
        assert process.stdout
        print(json.dumps(task), file=process.stdin, flush=True)
        assert process.stdout.readline(), "the rogue does not open a session"
        ground.drive()
        print("look", file=process.stdin, flush=True)
        received = json.loads(process.stdout.readline())
    ground.await_effects(ground.honest.session)
    own = set(task["put"])  # a client also receives its own messages
    overheard = [name for name in set(received) - own if not name.startswith(f"{keys.ROOT}/map/")]
    return (
        bool(overheard)
        or received.count(key(HONEST)) > 1
        or ground.monitor.has_payload(SECRET)
        or ground.reader.has_payload(SECRET)
    )


@register_attempt
def vehicle_that_plays_router(ground: Ground) -> bool:
    return as_router(ground, "router")


@register_attempt
def vehicle_that_plays_peer(ground: Ground) -> bool:
    return as_router(ground, "peer")


@register_attempt
def certificates_with_a_wildcard_or_a_tile_for_a_name(ground: Ground) -> bool:
    through = False
    for name in ("*", "**", "0123", "sim-*", "role/services"):
        with ground.network.open_session(
            name, ROUTERS[1], **issue_certificate(ground, name, ground.folder / "odd")
        ) as session:
            places = (
                key(HONEST),
                f"{keys.ROOT}/obs/1202/310/232/0123",
                keys.map_key(TILE),
                "gripmap/v1/ack/*",
            )
            for place in places:
                session.put(place, SECRET + name.encode())
            listener = Listener(session, (f"{keys.ROOT}/**",))
            list(session.get(f"{keys.ROOT}/map/**"))
            ground.drive()
            through |= bool(listener.received)
    ground.await_effects(ground.reader.session)
    return through or ground.monitor.has_payload(SECRET)


@register_attempt
def names_that_look_like_a_tile_or_a_path_are_enrolled(ground: Ground) -> bool:
    through = False
    for name in (
        "0123",
        "*",
        "**",
        "$*",
        "a/b",
        "../sim",
        "sim-000\n",
        "Sim-000",
        "",
        "@admin",
        "role/services",
    ):
        with suppress(ValueError):
            through |= bool(
                Enrolment.model_validate({"routers": {"router-a": {}}, "vehicles": [name]})
            )
    return through


@register_attempt
def one_name_with_two_roles(ground: Ground) -> bool:
    with suppress(ValueError):
        return bool(make_enrolment(vehicles=[SERVICE]))
    return False


@register_attempt
def batch_that_is_too_large_travels(ground: Ground) -> bool:
    session = ground.open_session(ROGUE, ROUTERS[1])
    session.put(key(ROGUE), SECRET + bytes(wire.MAX_BYTES))
    ground.await_effects(session)
    return ground.monitor.has_payload(SECRET)


@register_attempt
def private_message_that_is_too_large_travels(ground: Ground) -> bool:
    session = ground.open_session(ROGUE, ROUTERS[1])
    listener = Listener(ground.open_session(ROGUE), (keys.ahead_key(ROGUE),))

    def put_both() -> bool:
        session.put(keys.ahead_key(ROGUE), b"small")
        session.put(keys.ahead_key(ROGUE), SECRET + bytes(PRIVATE_BYTES))
        return len(listener.received) > 1

    until(put_both)
    return listener.has_payload(SECRET)


@register_attempt
def question_with_a_payload_travels(ground: Ground) -> bool:
    session = ground.open_session(ROGUE, ROUTERS[1])
    answered = ground.service.engine.counts.queries
    asked: Any = session.get(keys.map_key(TILE), payload=SECRET + bytes(wire.MAX_BYTES))
    through = any(reply.ok is not None for reply in asked)
    return through or ground.service.engine.counts.queries > answered


@register_attempt
def administration_of_the_routers(ground: Ground) -> bool:
    session = ground.open_session(ROGUE, ROUTERS[1])
    for router in session.info.routers_zid():
        session.put(f"@/{router}/router/config/access_control/enabled", "false")
    replies = session.get("@/*/router/**")
    return any(reply.ok for reply in replies) or put_by(ground, session, keys.ack_key(HONEST))


@register_attempt
def revoked_vehicle(ground: Ground) -> bool:
    """Connect with a certificate whose name was removed from the access list; True on success."""
    network = ground.network
    lost = {
        f"connect_{part}": str(ground.folder / f"lost.{end}")
        for part, end in (("certificate", "pem"), ("private_key", "key"))
    }
    for end in ("pem", "key"):
        (ground.folder / f"lost.{end}").write_bytes((ground.folder / f"{ROGUE}.{end}").read_bytes())
    (ground.folder / "lost.pem").rename(ground.folder / "lost.crt")
    lost["connect_certificate"] = str(ground.folder / "lost.crt")
    again = Registry(ground.folder, ValidityPeriods(), datetime.now(UTC))
    again.enrol(make_enrolment(vehicles=[HONEST]))
    for router in ROUTERS[::-1]:
        network.stop(router)
        network.start(router)
    session = ground.open_session(ROGUE, ROUTERS[1], **lost)
    session.put(key(ROGUE), SECRET)
    listener = Listener(session, (f"{keys.ROOT}/**",))
    list(session.get(f"{keys.ROOT}/map/**"))
    ground.drive()
    ground.drive()
    with suppress(InputError):
        return bool(again.enrol(make_enrolment()))
    return ground.monitor.has_payload(SECRET) or bool(listener.received)
