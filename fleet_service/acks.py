"""Acknowledgements: settled sequence numbers, gathered per vehicle and stream, as messages."""

from __future__ import annotations

from collections import defaultdict

from schemas.wire import Batch, Kind, StreamAck, encode_ack

_Stream = tuple[int, Kind, int]


class Acks:
    """What is to be told to whom."""

    def __init__(self) -> None:
        self._durable: dict[str, dict[_Stream, set[int]]] = defaultdict(lambda: defaultdict(set))
        self._rejected: dict[str, dict[_Stream, list[tuple[int, int, str]]]] = defaultdict(lambda: defaultdict(list))

    def durable(self, vehicle: str, batch: Batch) -> None:
        """The batch is on disk."""
        self._durable[vehicle][batch.boot, batch.kind, batch.region].add(batch.seq)

    def rejected(self, vehicle: str, batch: Batch, row: int, reason: str) -> None:
        """The batch was refused for good."""
        self._rejected[vehicle][batch.boot, batch.kind, batch.region].append((batch.seq, row, reason))

    def messages(self) -> list[tuple[str, bytes]]:
        """Vehicle and `Ack` bytes of everything gathered; starts anew."""
        out = []
        for vehicle in sorted(self._durable.keys() | self._rejected.keys()):
            durable, rejected = self._durable[vehicle], self._rejected[vehicle]
            streams = [
                StreamAck(*stream, ranges(durable.get(stream, set())), tuple(rejected.get(stream, ())))
                for stream in sorted(durable.keys() | rejected.keys())
            ]
            out.append((vehicle, encode_ack(vehicle, streams)))
        self._durable.clear()
        self._rejected.clear()
        return out


def ranges(numbers: set[int]) -> tuple[tuple[int, int], ...]:
    """Runs of consecutive numbers, both ends included."""
    out: list[tuple[int, int]] = []
    for n in sorted(numbers):
        if out and out[-1][1] == n - 1:
            out[-1] = (out[-1][0], n)
        else:
            out.append((n, n))
    return tuple(out)
