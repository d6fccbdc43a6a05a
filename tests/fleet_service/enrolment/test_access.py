"""Tests of the routers' access list with real sessions, real certificates and the generated list:
each party can use exactly its own keys.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import pytest
import zenoh

from fleet_service.enrolment.access import access_control
from fleet_service.enrolment.enrol import Registry, ValidityPeriods
from schemas import keys
from schemas.errors import InputError
from schemas.runtime import presence
from schemas.runtime.zenoh_session import configuration
from tests.faults.attempts import ATTEMPTS
from tests.faults.ground import HONEST, Ground, open_ground
from tests.fleet_service.examples import key
from tests.secured import (
    READER,
    ROUTERS,
    SERVICE,
    VEHICLES,
    Network,
    make_enrolment,
    open_network,
    open_registry,
    settings,
)
from tests.waiting import matched, until

# Attacks that fail whatever the routers do, because clients and service check for themselves.
HELD_WITHOUT_ROUTERS = {
    "certificate_without_its_key",
    "plain_tcp",
    "false_router_of_another_authority",
    "false_router_with_the_certificate_of_a_vehicle",
    "wildcard_put_on_ones_own_name",
    "another_name_within_ones_own_key",
    "names_that_look_like_a_tile_or_a_path_are_enrolled",
    "one_name_with_two_roles",
}


def breaches(where: Ground) -> set[str]:
    return {name for name, attempt in ATTEMPTS.items() if attempt(where)}


@pytest.fixture(params=["quic", "tls"])
def running(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Network]:
    with open_network(tmp_path, protocol=request.param) as found:
        yield found


@pytest.mark.campaign
def test_access_list_has_no_breach(running: Network) -> None:
    with open_ground(running) as found:
        assert breaches(found) == set()


@pytest.mark.campaign
@pytest.mark.parametrize("protocol", ["quic", "tls"])
def test_attacks_succeed_in_an_unprotected_network(tmp_path: Path, protocol: str) -> None:
    with (
        open_network(tmp_path, guarded=False, protocol=protocol) as open_to_all,
        open_ground(open_to_all) as found,
    ):
        assert breaches(found) == set(ATTEMPTS) - HELD_WITHOUT_ROUTERS


def test_vehicle_has_exactly_the_permissions_of_the_design() -> None:
    listed = access_control(make_enrolment())
    rules = {rule["id"]: rule for rule in listed["rules"]}
    granted = [
        rules[name]
        for policy in listed["policies"]
        if HONEST in policy["subjects"]
        for name in policy["rules"]
    ]

    def list_allowed(flow: str) -> set[tuple[str, str]]:
        ours = [rule for rule in granted if flow in rule["flows"]]
        return {
            (message, place)
            for rule in ours
            for message in rule["messages"]
            for place in rule["key_exprs"]
        }

    public = (f"{keys.ROOT}/map/**", f"{keys.ROOT}/alert/**")
    assert list_allowed("ingress") == {
        *(("put", f"{keys.ROOT}/{kind}/*/*/*/{HONEST}") for kind in ("obs", "state")),
        *(
            (message, place)
            for message in ("put", "declare_subscriber")
            for place in keys.private_keys(HONEST)
        ),
        ("liveliness_token", keys.alive_key(HONEST)),
        ("declare_subscriber", keys.ack_key(HONEST)),
        *((message, place) for message in ("declare_subscriber", "query") for place in public),
        *(
            (message, f"{keys.SERVES}/**")
            for message in ("liveliness_query", "declare_liveliness_subscriber")
        ),
    }
    assert list_allowed("egress") == {
        ("put", keys.ack_key(HONEST)),
        *(
            (message, place)
            for message in ("put", "declare_subscriber")
            for place in keys.private_keys(HONEST)
        ),
        *((m, place) for m in ("put", "reply") for place in public),
        *(("declare_subscriber", f"{keys.ROOT}/{kind}/**") for kind in ("obs", "state")),
        ("declare_queryable", f"{keys.ROOT}/map/**"),
        ("liveliness_token", f"{keys.SERVES}/**"),
    }
    assert (listed["enabled"], listed["default_permission"]) == (True, "deny")


def is_heard(vehicle: zenoh.Session, name: str, listener: zenoh.Session) -> bool:
    """Return True if a message that the session `vehicle` publishes on the key of the vehicle
    `name` reaches the service's `listener`.
    """
    received: list[bytes] = []
    with listener.declare_subscriber(
        f"{keys.ROOT}/obs/**", lambda sample: received.append(sample.payload.to_bytes())
    ):
        # Only a session with the service's rights learns who subscribes.
        publisher = listener.declare_publisher(key(name))

        def has_arrived() -> bool:
            vehicle.put(key(name), b"here")
            return bool(received)

        until(has_arrived)
        publisher.undeclare()
    return True


def test_readers_see_service_tokens_and_cannot_declare_them(running: Network) -> None:
    where = settings(next(iter(running.endpoints.values())), running.folder)
    served = keys.ServiceToken("1202/310/*", SERVICE, "1f")
    false = keys.ServiceToken("1202/311/*", HONEST, "2f")
    with (
        zenoh.open(configuration(where, SERVICE)) as service,
        zenoh.open(configuration(where, HONEST)) as vehicle,
        zenoh.open(configuration(where, READER)) as reader,
    ):
        vehicle.liveliness().declare_token(false.key)
        token = service.liveliness().declare_token(served.key)

        def sees(looks: zenoh.Session) -> bool:
            return served in presence.active_tokens(looks)

        for looks in (vehicle, reader):
            until(partial(sees, looks))
        with presence.track_tokens(reader) as seen:
            assert seen.active == {served}
            token.undeclare()
            until(lambda: seen.lost_tokens == {served})


def test_new_vehicle_is_admitted_during_a_rolling_router_restart(running: Network) -> None:
    both = list(running.endpoints.values())

    def anywhere(name: str) -> zenoh.Session:
        one = settings(both[0], running.folder).model_copy(update={"connect": both})
        return zenoh.open(configuration(one, name))

    with anywhere(SERVICE) as service, anywhere(HONEST) as honest:
        assert is_heard(honest, HONEST, service)
        assert open_registry(running.folder).enrol(
            make_enrolment(vehicles=[HONEST, "new-001"])
        ).issued == ["new-001"]
        for router in ROUTERS:
            running.stop(router)
            assert is_heard(honest, HONEST, service), "the other router is there"
            running.start(router)
            running.await_link()
        with anywhere("new-001") as new:
            assert is_heard(new, "new-001", service)


def test_a_session_takes_a_renewed_certificate_when_it_connects_again(running: Network) -> None:
    with running.open_session(SERVICE) as service, running.open_session(HONEST) as honest:
        assert is_heard(honest, HONEST, service)
        much_later = Registry(running.folder, ValidityPeriods(renew_days=364.9), datetime.now(UTC))
        for step in ("next", "switch", "drop"):
            much_later.enrol(make_enrolment(), step)
        for router in ROUTERS:
            running.stop(router)
        # The routers now trust only the new authority, so the old certificates are worthless.
        for router in ROUTERS:
            running.start(router)
        assert is_heard(honest, HONEST, service)


def test_old_and_new_authority_get_on_while_one_replaces_the_other(
    running: Network, tmp_path: Path
) -> None:
    open_registry(running.folder).enrol(make_enrolment(), "next")
    for router in ROUTERS[::-1]:
        running.stop(router)
        running.start(router)
    before = tmp_path / "as it was"
    shutil.copytree(
        running.folder, before, ignore=shutil.ignore_patterns("authority", "archive", before.name)
    )
    open_registry(running.folder).enrol(make_enrolment(), "switch")
    running.stop(ROUTERS[1])
    running.start(ROUTERS[1])
    running.await_link()
    old = zenoh.open(configuration(settings(running.endpoints[ROUTERS[1]], before), HONEST))
    with old, running.open_session(SERVICE, ROUTERS[0]) as service:
        assert is_heard(old, HONEST, service)


def test_missing_certificate_is_reported_by_name(tmp_path: Path) -> None:
    with pytest.raises(
        InputError,
        match=r"^zenoh.config.transport/link/tls/root_ca_certificate: there is no file .*",
    ):
        configuration(settings("tls/127.0.0.1:1", tmp_path), HONEST)


def test_declared_publisher_learns_of_matching_subscribers(running: Network) -> None:
    """The access list must let a vehicle's declared publisher learn that a service subscribes.
    Otherwise the vehicle would send nothing and get no error.
    """
    received: list[bytes] = []
    with (
        running.open_session(SERVICE) as service,
        running.open_session(HONEST, ROUTERS[1]) as vehicle,
    ):
        service.declare_subscriber(
            f"{keys.ROOT}/obs/*/*/*/*", lambda sample: received.append(sample.payload.to_bytes())
        )
        publisher = vehicle.declare_publisher(key(HONEST))
        matched(publisher)
        publisher.put(b"here")
        until(lambda: received)


@pytest.mark.parametrize("own", [keys.ahead_key, keys.vss_key])
def test_private_keys_of_a_vehicle_are_for_it_and_its_owner_alone(
    tmp_path: Path, own: Callable[[str], str]
) -> None:
    other = next(name for name in VEHICLES if name != HONEST)
    fleet = make_enrolment(owners={"owner-0": [HONEST], "owner-1": [other]})
    listeners = (HONEST, other, SERVICE, READER, "owner-0", "owner-1")
    heard_by: dict[str, list[bytes]] = {name: [] for name in listeners}
    with open_network(tmp_path, fleet=fleet) as found, ExitStack() as stack:
        sessions = {name: stack.enter_context(found.open_session(name)) for name in listeners}
        for name, session in sessions.items():
            for expression in (own(HONEST), own("*"), "gripmap/**"):
                stack.enter_context(session.declare_subscriber(expression, _noting(heard_by[name])))
        publisher = sessions[HONEST].declare_publisher(own(HONEST))
        matched(publisher)

        def has_arrived() -> bool:
            publisher.put(b"ice")
            sessions[other].put(own(HONEST), b"a lie")
            return bool(heard_by[HONEST] and heard_by["owner-0"])

        until(has_arrived)
        assert set(heard_by[HONEST] + heard_by["owner-0"]) == {b"ice"}
        # A query's answer shows that earlier messages have reached the other routers, too.
        for name in (other, SERVICE, READER, "owner-1"):
            list(sessions[name].get(f"{keys.ROOT}/map/**"))
            assert b"ice" not in heard_by[name]


def test_owner_of_an_unknown_vehicle_is_refused() -> None:
    with pytest.raises(ValueError, match="is not a vehicle"):
        make_enrolment(owners={"owner-0": ["nobody-1"]})


def _noting(received: list[bytes]) -> Callable[[zenoh.Sample], None]:
    return lambda sample: received.append(sample.payload.to_bytes())
