"""Live sources of vehicle signals, in the notation of the command line:
`kind:address?option=value&option=value`.

can:socketcan/can0, can:virtual/bench    CAN bus read by the library python-can; the address is its
                                         interface and channel. Option `bus`: number of this bus in
                                         the profile (by default the number in the channel's name).
                                         Other options are passed to python-can.
ros2:tcp/127.0.0.1:7447                  topics of ROS 2 (rmw_zenoh), received from the Zenoh router
                                         at this address. Option `domain`: ROS domain (default 0);
                                         `frames=/can0`: topic that carries CAN frames
                                         (can_msgs/Frame); `messages=FOLDER`: folder with the
                                         definitions PACKAGE/NAME.msg of your own message types
vss:127.0.0.1:55555                      Kuksa databroker at this address. Option `ca=FILE`:
                                         certificate authority, for TLS; `token=FILE`: token by
                                         which the agent authenticates itself
gpsd:127.0.0.1:2947                      position receiver, through the gpsd at this address
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final
from urllib.parse import parse_qsl

from edge_agent.inputs.context import lasting_signals
from edge_agent.inputs.live.can_bus import CanFeed, Decoder
from edge_agent.inputs.live.databroker import DatabrokerFeed
from edge_agent.inputs.live.feed import Feed, HostClock
from edge_agent.inputs.live.gpsd import GpsdFeed
from edge_agent.inputs.live.kuksa.connection import FILES
from edge_agent.inputs.live.ros2 import Ros2Feed, RosTopics
from edge_agent.inputs.profile import Profile, load_profile
from edge_agent.inputs.readers.can_log import no_database
from edge_agent.inputs.readers.dbc import Database, database_of
from schemas.config import ZenohSettings
from schemas.errors import InputError
from schemas.runtime.commandline import is_port

KINDS: Final = ("can", "gpsd", "ros2", "vss")
PORTS: Final = {"gpsd": 2947, "vss": 55555}
VSS_PROFILE: Final = "vss"
# options of the kinds whose options are not passed to a library
OPTIONS: Final = {"gpsd": (), "ros2": ("domain", "frames", "messages"), "vss": FILES}


def is_live(source: str) -> bool:
    """Return True if a source given to `run` is a live source."""
    return source.partition(":")[0] in KINDS


def open_sources(
    sources: Sequence[str], profile_name: str | None, dbc: Path | None = None
) -> tuple[list[Feed], Profile, HostClock]:
    """Create the live sources; return them with their profile (assignment of signals to channels)
    and their common clock.

    Args:
        sources: sources in the notation of the command line.
        profile_name: file or name of a shipped profile; for a databroker alone it is optional.
        dbc: CAN database; by default the one that the profile names.

    Raises:
        InputError: a source, its profile or its library is missing or invalid.
    """
    kinds = [source.partition(":")[0] for source in sources]
    if profile_name is None and "vss" in kinds:
        profile_name = VSS_PROFILE
    if profile_name is None:
        raise InputError(
            "profile",
            "is not given",
            "map signals to channels with --profile (edge-agent import drafts one)",
        )
    profile, folder = load_profile(profile_name)
    database = database_of(profile, folder, dbc)
    clock = HostClock()
    return [_open_source(source, profile, database, clock) for source in sources], profile, clock


def _open_source(
    source: str, profile: Profile, database: Database | None, clock: HostClock
) -> Feed:
    kind, _, rest = source.partition(":")
    address, _, query = rest.partition("?")
    try:
        options = dict(parse_qsl(query, strict_parsing=True)) if query else {}
    except ValueError as error:
        raise InputError(
            "source", f"{source!r} has invalid options ({error})", "write them like ?bus=1&fd=true"
        ) from error
    for name in options:
        if name not in (known := OPTIONS.get(kind, options)):
            fix = f"use {', '.join(known)}" if known else "remove it"
            raise InputError("source", f"{source!r}: the option {name} is unknown", fix)
    if kind == "can":
        if database is None:
            raise no_database(Path(source))
        return _open_can(source, address, options, profile, database, clock)
    if kind == "gpsd":
        return GpsdFeed(source, clock, _parse_host(source, address, PORTS[kind]))
    if kind == "vss":
        return DatabrokerFeed(
            source,
            clock,
            address or f"127.0.0.1:{PORTS[kind]}",
            sorted(profile.needed_signals()),
            options,
            lasting=lasting_signals(profile),
        )
    if kind == "ros2":
        return _open_ros2(
            source,
            address,
            options,
            profile,
            database,
            clock,
        )
    raise InputError(
        "source",
        f"{source!r} is of an unknown kind",
        f"begin it with one of {', '.join(KINDS)} and a colon",
    )


def _open_can(
    source: str,
    address: str,
    options: dict[str, str],
    profile: Profile,
    database: Database,
    clock: HostClock,
) -> Feed:
    interface, slash, channel = address.partition("/")
    if not slash or not channel:
        raise InputError("source", f"{source!r} has no channel", "write it like can:socketcan/can0")
    # A name such as can1 contains the number of the bus, an address does not.
    number = re.fullmatch(r"[a-zA-Z]+(\d{1,3})", channel)
    given_bus = options.pop("bus", number[1] if number else "")
    if given_bus and not given_bus.isdecimal():
        raise InputError("source", f"{source!r}: the bus is not a number", "write it like ?bus=0")
    bus = int(given_bus) if given_bus else None
    bus_options = {name: _parse_option(value) for name, value in options.items()}
    return CanFeed(
        source,
        clock,
        Decoder(profile, database, bus),
        {"interface": interface, "channel": channel} | bus_options,
    )


def _open_ros2(
    source: str,
    address: str,
    options: dict[str, str],
    profile: Profile,
    database: Database | None,
    clock: HostClock,
) -> Feed:
    settings = ZenohSettings(connect=[address]) if address else ZenohSettings()
    domain = options.get("domain", "0")
    folder = options.get("messages")
    if not domain.isdigit():
        raise InputError(
            "source", f"{source!r}: the domain is not a number", "write it like ?domain=0"
        )
    return Ros2Feed(
        source,
        clock,
        settings,
        RosTopics(
            int(domain),
            sorted(profile.needed_signals()),
            None if database is None else Decoder(profile, database),
            options.get("frames", "").split(),
            Path(folder) if folder else None,
        ),
    )


def _parse_option(text: str) -> int | float | bool | str:
    """Return the value of an option in the type that python-can expects: bool, int, float
    or str.
    """
    if text in ("true", "false"):
        return text == "true"
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def _parse_host(source: str, address: str, port: int) -> tuple[str, int]:
    host, _, number = (
        address.rpartition(":") if ":" in address else (address or "127.0.0.1", "", str(port))
    )
    if not is_port(number):
        raise InputError(
            "source", f"{source!r} has no port", f"write it like gpsd:127.0.0.1:{port}"
        )
    return host, int(number)
