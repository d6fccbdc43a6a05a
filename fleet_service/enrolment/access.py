"""Configuration of a Zenoh router: mutual TLS, and an access list that denies everything not listed
here. Pure (no I/O).

| role    | may publish                          | may read and query                     |
|---------|--------------------------------------|----------------------------------------|
| reader  | nothing                              | PUBLIC keys                            |
| vehicle | obs/*/*/*/NAME, state/*/*/*/NAME,    | PUBLIC keys, ack/NAME,                 |
|         | alive/NAME, own PRIVATE keys         | own PRIVATE keys                       |
| owner   | nothing                              | PUBLIC keys, PRIVATE keys of the       |
|         |                                      | vehicles that it owns                  |
| weather | weather/**                           | nothing                                |
| service | all keys except PRIVATE keys         | all keys except PRIVATE keys           |
| router  | all keys, to forward messages        | all keys, to forward messages          |

The table omits the prefix gripmap/v1/ of the keys. NAME is the name in the vehicle's certificate.
PUBLIC keys are map/**, alert/** and serves/**. The PRIVATE keys of a vehicle are ahead/NAME (the
road ahead) and vss/NAME (the friction at the vehicle).

Zenoh identifies a client by the common name of its certificate. It reads the list only at its
start. The sender is not informed about denials. Publishing on a wildcard counts as publishing on
every matching key, so a rule must allow all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from fleet_service.enrolment.fleet import Enrolment
from schemas import keys, wire

# Largest size [bytes] of payload and attachment of a query; valid queries have neither.
QUERY_BYTES: Final = 1024
# Largest size [bytes] of a picture of the map ahead, or of the signals: ten times the largest
# measured.
PRIVATE_BYTES: Final = 256 * 1024
PUBLIC: Final = (f"{keys.ROOT}/map/**", f"{keys.ROOT}/alert/**")
WEATHER: Final = f"{keys.ROOT}/weather/**"
SERVED: Final = f"{keys.SERVES}/**"
EVERYTHING: Final = "gripmap/**"
MESSAGES: Final = (
    "put",
    "delete",
    "declare_subscriber",
    "query",
    "reply",
    "declare_queryable",
    "liveliness_token",
    "liveliness_query",
    "declare_liveliness_subscriber",
)
MAX_SESSIONS: Final = 5000  # one per vehicle; Zenoh's own limit is 1000
# [bytes] A whole tile as GeoJSON is about 50 MB. Without this limit, Zenoh would join fragments up
# to a gigabyte before it checks the size.
MAX_MESSAGE: Final = 64 * 1024 * 1024
LEASE_MS: Final = 3000  # [ms] time after which a silent peer counts as disconnected

Section = dict[str, Any]


def router_configuration(fleet: Enrolment, name: str, certificates: Path) -> Section:
    """Return the configuration of the router `name`; `certificates` is the folder that contains its
    certificate and key.
    """
    router = fleet.routers[name]
    before = list(fleet.routers)[: list(fleet.routers).index(name)]
    certificate = str(certificates / f"{name}.pem")
    key = str(certificates / f"{name}.key")
    return {
        "mode": "router",
        "listen": {"endpoints": router.listens},
        "connect": {"endpoints": [fleet.routers[other].router_endpoint for other in before]},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}, "delay": 0},
        "transport": {
            # If a receiver stalls, shared memory drops samples without an error.
            "shared_memory": {"enabled": False},
            "unicast": {"max_sessions": MAX_SESSIONS},
            "link": {
                "protocols": router.protocols,
                "tx": {"lease": LEASE_MS},
                "rx": {"max_message_size": MAX_MESSAGE},
                "tls": {
                    "root_ca_certificate": str(certificates / "trust.pem"),
                    "listen_certificate": certificate,
                    "listen_private_key": key,
                    "connect_certificate": certificate,
                    "connect_private_key": key,
                    "enable_mtls": True,
                    "verify_name_on_connect": True,
                    "close_link_on_expiration": True,
                },
            },
        },
        "access_control": access_control(fleet),
        "low_pass_filter": [_no_larger(), _no_larger_private(), _no_payload()],
        "downsampling": rate_caps(fleet, name),
        "qos": {"network": [_topic_priority(keys.TOPICS[kind]) for kind in wire.Kind]},
    }


def rate_caps(fleet: Enrolment, name: str) -> list[Section]:
    """Return the rules that limit the message rate of each session at the router `name`, so that a
    flooding vehicle does not slow down others.

    A session of another router carries the messages of many vehicles and must not be limited. Zenoh
    cannot distinguish a router from a vehicle, so the rules depend on the kind of connection:

    - QUIC sessions are always limited, because routers never use QUIC to reach each other.
    - TLS sessions are all limited if there is only one router.
    - If there are several routers, TLS sessions are limited only on the router's
      `vehicle_interfaces`, the network interfaces on which no other router connects.
    """
    router = fleet.routers[name]
    caps = [_rate_cap("quic", {"link_protocols": ["quic"]})] if router.quic else []
    if len(fleet.routers) == 1:
        return [*caps, _rate_cap("tls", {"link_protocols": ["tls"]})]
    if router.vehicle_interfaces:
        where = {"interfaces": router.vehicle_interfaces, "link_protocols": ["tls"]}
        return [*caps, _rate_cap("tls", where)]
    return caps


def _rate_cap(name: str, where: Section) -> Section:
    capped = (*wire.Kind, *keys.PRIVATE)
    rules = [{"key_expr": f"{keys.ROOT}/{kind}/**", "freq": wire.MESSAGES_PER_S} for kind in capped]
    return {
        "id": f"rate-{name}",
        "flows": ["ingress"],
        "messages": ["put", "delete"],
        **where,
        "rules": rules,
    }


def access_control(fleet: Enrolment) -> Section:
    """Return the access list (who may publish and read what) for an enrolment; it is the same at
    all routers.
    """
    own = {name: _own_rules(name) for name in fleet.vehicles}
    for name, owned in fleet.owners.items():
        if owned:
            expressions = [key for vehicle in owned for key in keys.private_keys(vehicle)]
            own[name] = _subscriber_rules(name, expressions)
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [*_shared_rules(), *(rule for rules in own.values() for rule in rules)],
        "subjects": _subjects(fleet),
        "policies": [
            *_role_policies(fleet),
            *(
                {"rules": [rule["id"] for rule in rules], "subjects": [name]}
                for name, rules in own.items()
            ),
        ],
    }


def _shared_rules() -> list[Section]:
    return [
        _allow_rule("everything", ("ingress", "egress"), MESSAGES, [EVERYTHING]),
        _allow_rule("private", ("ingress", "egress"), MESSAGES, keys.private_keys("*"))
        | {"permission": "deny"},
        _allow_rule("map-request", ("ingress",), ("declare_subscriber", "query"), PUBLIC),
        _allow_rule("map-delivery", ("egress",), ("put", "reply"), PUBLIC),
        # Until Zenoh tells a declared publisher or querier that a subscriber exists, it sends
        # nothing and reports no error.
        _allow_rule(
            "report-subscribers",
            ("egress",),
            ("declare_subscriber",),
            [f"{keys.ROOT}/{kind}/**" for kind in wire.Kind],
        ),
        _allow_rule("weather", ("ingress",), ("put",), [WEATHER]),
        _allow_rule("weather-subscribers", ("egress",), ("declare_subscriber",), [WEATHER]),
        # Readers may see which services serve a region. Otherwise a region without a service looks
        # like a region without grip reports.
        _allow_rule(
            "service-request",
            ("ingress",),
            ("liveliness_query", "declare_liveliness_subscriber"),
            [SERVED],
        ),
        _allow_rule("service-delivery", ("egress",), ("liveliness_token",), [SERVED]),
        _allow_rule("map-queryables", ("egress",), ("declare_queryable",), [f"{keys.ROOT}/map/**"]),
    ]


def _subjects(fleet: Enrolment) -> list[Section]:
    roles = {
        "routers": list(fleet.routers),
        "services": fleet.services,
        "readers": fleet.readers,
        "weather": fleet.weather,
    }
    return [
        *(
            {"id": f"role/{role}", "cert_common_names": names}
            for role, names in roles.items()
            if names
        ),
        *({"id": name, "cert_common_names": [name]} for name in (*fleet.vehicles, *fleet.owners)),
    ]


def _role_policies(fleet: Enrolment) -> list[Section]:
    """Return the assignments of the shared rules to roles, and to all vehicles and owners."""
    services = ["role/services"] if fleet.services else []
    weather = ["role/weather"] if fleet.weather else []
    readers = ["role/readers"] if fleet.readers else []
    assigned = [
        (["everything"], ["role/routers", *services]),
        (["private"], services),
        (
            [
                "map-request",
                "map-delivery",
                "map-queryables",
                "service-request",
                "service-delivery",
            ],
            [*readers, *fleet.vehicles, *fleet.owners],
        ),
        (["weather", "weather-subscribers"], weather),
        (["report-subscribers"], fleet.vehicles),
    ]
    return [{"rules": rules, "subjects": subjects} for rules, subjects in assigned if subjects]


def _own_rules(name: str) -> list[Section]:
    return [
        _allow_rule(
            f"put/{name}",
            ("ingress",),
            ("put",),
            [*(f"{keys.ROOT}/{kind}/*/*/*/{name}" for kind in wire.Kind), *keys.private_keys(name)],
        ),
        # A declared publisher sends nothing until Zenoh tells it that the vehicle has subscribed.
        _allow_rule(
            f"private-subscribers/{name}",
            ("egress",),
            ("declare_subscriber",),
            keys.private_keys(name),
        ),
        *_subscriber_rules(name, keys.private_keys(name)),
        _allow_rule(f"alive/{name}", ("ingress",), ("liveliness_token",), [keys.alive_key(name)]),
        _allow_rule(
            f"ack-request/{name}", ("ingress",), ("declare_subscriber",), [keys.ack_key(name)]
        ),
        _allow_rule(f"ack-delivery/{name}", ("egress",), ("put",), [keys.ack_key(name)]),
    ]


def _subscriber_rules(name: str, expressions: list[str]) -> list[Section]:
    return [
        _allow_rule(f"private-request/{name}", ("ingress",), ("declare_subscriber",), expressions),
        _allow_rule(f"private-delivery/{name}", ("egress",), ("put",), expressions),
    ]


def _allow_rule(
    name: str, flows: Sequence[str], messages: Sequence[str], expressions: Sequence[str]
) -> Section:
    return {
        "id": name,
        "permission": "allow",
        "flows": list(flows),
        "messages": list(messages),
        "key_exprs": list(expressions),
    }


def _no_larger() -> Section:
    """Return a router rule that stops batches of measurements that are larger than the service
    accepts. It applies at the router to which the sender connects.
    """
    return {
        "id": "batches",
        "flows": ["ingress"],
        "messages": ["put"],
        "key_exprs": [f"{keys.ROOT}/{kind}/**" for kind in wire.Kind],
        "size_limit": wire.MAX_BYTES,
    }


def _no_larger_private() -> Section:
    """Return a router rule that stops private messages of a vehicle (keys ahead/NAME and vss/NAME)
    that are larger than any agent writes. It applies at the router to which the sender connects.
    """
    return {
        "id": "private",
        "flows": ["ingress"],
        "messages": ["put"],
        "key_exprs": list(keys.private_keys("*")),
        "size_limit": PRIVATE_BYTES,
    }


def _no_payload() -> Section:
    """Return a router rule that stops queries with a payload, because a query of this project
    consists of its key and parameters only. It applies at the router to which the sender connects.
    """
    return {
        "id": "queries",
        "flows": ["ingress"],
        "messages": ["query"],
        "key_exprs": [f"{keys.ROOT}/**"],
        "size_limit": QUERY_BYTES,
    }


def _topic_priority(topic: keys.Topic) -> Section:
    """Return a router rule that gives each message the priority of its topic, in place of the
    priority that its sender chose.
    """
    return {
        "id": f"priority-{topic.name}",
        "flows": ["ingress"],
        "messages": ["put"],
        "key_exprs": [f"{keys.ROOT}/{topic.name}/**"],
        "overwrite": {"priority": topic.priority.lower(), "express": False},
    }
