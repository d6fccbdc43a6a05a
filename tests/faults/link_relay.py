"""`python -m tests.faults.link_relay JSON`: simulated mobile link between two network namespaces,
with packet loss, delay and limited rate.

Each namespace gets a TUN device, and this process moves packets between the two devices. It drops
some packets at random. The others wait in a queue of limited length for the rate of the link, and
are delivered after the delay. No kernel module except TUN is needed. A line of JSON on stdin
changes the settings, for example `{"drop_udp": true}`.
"""

from __future__ import annotations

import ctypes
import fcntl
import heapq
import json
import os
import random
import selectors
import struct
import sys
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

TUNSETIFF: Final = 0x400454CA  # from linux/if_tun.h
IFF_TUN: Final = 0x0001
IFF_NO_PI: Final = 0x1000  # packets have no header of the driver
CLONE_NEWNET: Final = 0x40000000
PACKET: Final = 65536
UDP: Final = 17  # protocol number in an IPv4 header
DEVICE: Final = "grip0"


@dataclass(frozen=True)
class LinkTerms:
    """Properties of a link, the same in both directions.

    Attributes:
        loss: share of packets that are lost.
        delay_s: delay of one direction.
        bytes_per_s: rate; 0 for no limit.
        queue_bytes: length of the queue of packets that wait for the rate; others are lost.
        drop_udp: True for a network that blocks UDP.
        seed: seed of the random losses.
    """

    loss: float = 0.0
    delay_s: float = 0.0
    bytes_per_s: float = 0.0
    queue_bytes: int = 100_000
    drop_udp: bool = False
    seed: int = 0


@dataclass
class Direction:
    """One direction of the link: packets in flight, and the time at which the rate allows the next
    packet.
    """

    out: int
    flying: list[tuple[float, int, bytes]] = field(default_factory=list)
    free_at: float = 0.0
    number: int = 0

    def accept_packet(
        self, packet: bytes, now: float, terms: LinkTerms, draw: random.Random
    ) -> None:
        """Queue an IP packet for delivery at the other end of the link. Drop the packet in three
        cases: the link blocks UDP and the packet is UDP; a random loss occurs, with the probability
        `terms.loss`; or the queue is full.
        """
        if terms.drop_udp and len(packet) > 9 and packet[9] == UDP:
            return
        if draw.random() < terms.loss:
            return
        self.free_at = max(self.free_at, now)
        if terms.bytes_per_s:
            if (self.free_at - now) * terms.bytes_per_s > terms.queue_bytes:
                return
            self.free_at += len(packet) / terms.bytes_per_s
        self.number += 1
        heapq.heappush(self.flying, (self.free_at + terms.delay_s, self.number, packet))

    def deliver_packets(self, now: float) -> None:
        """Deliver the packets whose delay has ended by the time `now` [s]: write them to the
        network device at the other end of the link.
        """
        while self.flying and self.flying[0][0] <= now:
            packet = heapq.heappop(self.flying)[2]
            try:
                os.write(self.out, packet)
            except OSError:  # the other end is full, or its device is down: drop the packet
                continue


def enter_namespace(namespace: str) -> None:
    """Move this thread into the Linux network namespace of this name."""
    with Path("/run/netns", namespace).open("rb") as file:
        if ctypes.CDLL(None, use_errno=True).setns(file.fileno(), CLONE_NEWNET):
            raise OSError(ctypes.get_errno(), f"cannot enter the network namespace {namespace}")


def open_device(namespace: str, device: str) -> int:
    """Create a TUN device in a namespace, and return its file descriptor."""
    enter_namespace(namespace)
    found = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(found, TUNSETIFF, struct.pack("16sH", device.encode(), IFF_TUN | IFF_NO_PI))
    return found


def relay_packets(ends: tuple[int, int], terms: LinkTerms) -> None:
    """Move packets between the network devices of both ends of the link until stdin is closed."""
    ways = {ends[0]: Direction(ends[1]), ends[1]: Direction(ends[0])}
    draw = random.Random(terms.seed)
    with selectors.DefaultSelector() as waiting:
        for end in (*ends, sys.stdin.fileno()):
            waiting.register(end, selectors.EVENT_READ)
        is_open = True
        while is_open:
            first = min((way.flying[0][0] for way in ways.values() if way.flying), default=None)
            patience = None if first is None else max(first - time.monotonic(), 0.0)
            for key, _ in waiting.select(patience):
                if key.fd in ways:
                    for packet in _read_packets(key.fd):
                        ways[key.fd].accept_packet(packet, time.monotonic(), terms, draw)
                elif line := sys.stdin.readline():
                    terms = replace(terms, **json.loads(line))
                else:
                    is_open = False
            now = time.monotonic()
            for way in ways.values():
                way.deliver_packets(now)


def _read_packets(device: int) -> list[bytes]:
    found: list[bytes] = []
    while len(found) < 64:
        try:
            found.append(os.read(device, PACKET))
        except BlockingIOError:
            break
    return found


def main() -> int:
    """Create the network devices of both ends of the link, print `relay: ready`, and pass packets
    between them until stdin is closed.
    """
    given = json.loads(sys.argv[1])
    ends = (
        open_device(given["left"], given["device"]),
        open_device(given["right"], given["device"]),
    )
    print("relay: ready", flush=True)
    relay_packets(ends, LinkTerms(**given["terms"]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
