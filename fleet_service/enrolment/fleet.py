"""Enrolment file: every name that may open a Zenoh session, by role. Certificates and access list
are made from it alone.
"""

from __future__ import annotations

import ipaddress
import re
from collections import Counter
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from schemas.config import Settings, VehicleName

_LABEL = r"[A-Za-z0-9](?:[A-Za-z0-9-]{0,61}[A-Za-z0-9])?"  # RFC 1123, section 2.1
# Each character can match in only one way, so a wrong name is rejected without backtracking.
_HOST = re.compile(rf"(?:{_LABEL}\.)*{_LABEL}\.?")


def _checked_host(host: str) -> str:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        if len(host) > 253 or not _HOST.fullmatch(host):
            raise ValueError(f"{host[:60]!r} is neither a host name nor an address") from None
    return host


def _checked_address(host: str) -> str:
    if host != "localhost":
        try:
            ipaddress.ip_address(host)
        except ValueError:
            raise ValueError(f"{host[:60]!r} is no address, as 127.0.0.1 or :: (all)") from None
    return host


Step = Literal["next", "switch", "drop"]  # steps of a change of the certificate authority
Host = Annotated[str, AfterValidator(_checked_host)]


class Router(Settings):
    """Zenoh router with the addresses and ports at which it can be reached."""

    hosts: list[Host] = Field(
        default=["127.0.0.1", "localhost"],
        min_length=1,
        description="host names and addresses of the router",
    )
    listen: Annotated[str, AfterValidator(_checked_address)] = Field(
        default="127.0.0.1", description="listen address; :: for all"
    )
    port: int = Field(
        default=7447,
        ge=1,
        le=65535,
        description="port of both transports: QUIC over UDP, TLS over TCP",
    )
    quic: bool = Field(
        default=True, description="listen on QUIC too; false where UDP cannot reach the router"
    )
    vehicle_interfaces: list[str] = Field(
        default=[],
        description="network interfaces on which no other router connects; TLS sessions are "
        "limited there too",
    )

    @property
    def endpoints(self) -> list[str]:
        """Return the router's endpoints for clients, in the order in which clients try them."""
        return [_format_endpoint(protocol, self.hosts[0], self.port) for protocol in self.protocols]

    @property
    def router_endpoint(self) -> str:
        """Return the router's endpoint for other routers. It uses TLS, so that rate limits on QUIC
        apply to vehicles only.
        """
        return _format_endpoint("tls", self.hosts[0], self.port)

    @property
    def listens(self) -> list[str]:
        """Return the addresses (endpoints) on which the Zenoh router listens."""
        return [_format_endpoint(protocol, self.listen, self.port) for protocol in self.protocols]

    @property
    def protocols(self) -> list[str]:
        """Return the router's transports. QUIC comes first: it survives a change of the car's
        network address and has one stream per priority.
        """
        return ["quic", "tls"] if self.quic else ["tls"]


def _format_endpoint(protocol: str, host: str, port: int) -> str:
    return f"{protocol}/[{host}]:{port}" if ":" in host else f"{protocol}/{host}:{port}"


class Enrolment(Settings):
    """Content of the enrolment file: names by role. Each name has one role only, because the
    certificate contains only the name.
    """

    routers: dict[VehicleName, Router] = Field(
        min_length=1, description="routers; each connects to those before it"
    )
    services: list[VehicleName] = Field(
        default=["shard-0"], description="services; may read and write everything under gripmap/"
    )
    readers: list[VehicleName] = Field(default=[], description="readers of map and alerts only")
    weather: list[VehicleName] = Field(default=[], description="writers of road weather only")
    vehicles: list[VehicleName] = Field(
        default=[], description="vehicles; may write their own keys and read map and alerts"
    )
    owners: dict[VehicleName, list[VehicleName]] = Field(
        default={},
        description="owners; may read what their vehicles publish about the road ahead and below, "
        "and all that readers may",
    )

    @property
    def names(self) -> list[str]:
        """Return all enrolled names, of all roles."""
        return [
            *self.routers,
            *self.services,
            *self.readers,
            *self.weather,
            *self.vehicles,
            *self.owners,
        ]

    @model_validator(mode="after")
    def _one_role_each(self) -> Enrolment:
        twice = [name for name, times in Counter(self.names).items() if times > 1]
        if twice:
            raise ValueError(f"{twice[0]!r} occurs twice, but a name has only one role")
        strange = [
            name for owned in self.owners.values() for name in owned if name not in self.vehicles
        ]
        if strange:
            raise ValueError(f"{strange[0]!r} has an owner but is not a vehicle")
        return self
