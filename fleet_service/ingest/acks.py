"""Acknowledgements: sequence numbers of durable or rejected batches (messages with records),
collected per stream (batches of one vehicle, start, kind and region), and sent as messages.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator
from typing import Final

from fleet_service.ingest.dedup import BatchId, SequenceTracker
from schemas.wire import Kind, StreamAck, encode_ack
from schemas.wire.batches import Head

# Limit that keeps an ack below the largest message that a receiver accepts (wire.MAX_BYTES). A
# stream may have 24 refusals of 150 bytes.
STREAMS_PER_ACK: Final = 16
ITEMS_PER_STREAM: Final = 24
AckedStream = tuple[int, Kind, int]  # boot, kind, region


class Acks:
    """Collected acknowledgements that have not been sent yet, grouped by stream."""

    def __init__(self) -> None:
        self._durable: dict[SequenceTracker, list[int]] = defaultdict(list)
        self._late: dict[SequenceTracker, set[int]] = defaultdict(set)
        self._rejected: dict[str, dict[AckedStream, list[tuple[int, int, str]]]] = defaultdict(
            lambda: defaultdict(list)
        )

    def record_durable(self, batches: Iterable[BatchId]) -> None:
        """Record that batches are durable on disk, so that their senders get an acknowledgement."""
        durable = self._durable
        for stream, seq in batches:
            durable[stream].append(seq)

    def record_late(self, batches: Iterable[BatchId]) -> None:
        """Record that batches (messages) contain records that were older than the map's limit when
        they arrived. Their senders learn this from the acknowledgement of the batches.
        """
        for stream, seq in batches:
            self._late[stream].add(seq)

    def record_rejected(self, vehicle: str, batch: Head, row: int, reason: str) -> None:
        """Record that a batch was rejected because of the row `row`, and the reason that is sent to
        its sender.
        """
        self._rejected[vehicle][batch.boot, batch.kind, batch.region].append(
            (batch.seq, row, reason)
        )

    def messages(self, time: int = 0) -> list[tuple[str, bytes]]:
        """Return pairs of vehicle name and bytes of an `Ack` message for everything collected, and
        clear the collection. `time` is the service's clock [ns], which is part of the message.
        """
        settled: dict[str, dict[AckedStream, list[int]]] = {
            vehicle: {} for vehicle in self._rejected
        }
        late: dict[tuple[str, AckedStream], set[int]] = defaultdict(set)
        for stream, seqs in self._durable.items():
            name = (stream.boot, *stream.key[2:])
            settled.setdefault(stream.vehicle, {}).setdefault(name, []).extend(seqs)
            if stream in self._late:
                unreported = self._late[stream].intersection(seqs)
                late[stream.vehicle, name] |= unreported
                self._late[stream] -= unreported
                if not self._late[stream]:
                    del self._late[stream]
        out = []
        for vehicle, durable in sorted(settled.items()):
            rejected = self._rejected.get(vehicle, {})
            streams = [
                part
                for stream in sorted(durable.keys() | rejected.keys())
                for part in _split_stream(
                    stream,
                    consecutive_ranges(durable.get(stream, ())),
                    tuple(rejected.get(stream, ())),
                    consecutive_ranges(late.get((vehicle, stream), ())),
                )
            ]
            out += [
                (vehicle, encode_ack(vehicle, streams[at : at + STREAMS_PER_ACK], time))
                for at in range(0, len(streams), STREAMS_PER_ACK)
            ]
        self._durable.clear()
        self._rejected.clear()
        return out


def _split_stream(
    stream: AckedStream,
    durable: tuple[tuple[int, int], ...],
    rejected: tuple[tuple[int, int, str], ...],
    late: tuple[tuple[int, int], ...],
) -> Iterator[StreamAck]:
    """Yield the acknowledgements of a stream (batches of one vehicle, kind and region) in pieces of
    at most ITEMS_PER_STREAM items.
    """
    for at in range(0, max(len(durable), len(rejected), len(late)), ITEMS_PER_STREAM):
        piece = slice(at, at + ITEMS_PER_STREAM)
        yield StreamAck(*stream, durable[piece], rejected[piece], late[piece])


def consecutive_ranges(numbers: Iterable[int]) -> tuple[tuple[int, int], ...]:
    """Return the ranges of consecutive sequence numbers as pairs (first, last), both included; the
    given sequence numbers may be repeated and unsorted.
    """
    ordered = sorted(set(numbers))
    # The most frequent case: the numbers are consecutive.
    if ordered and ordered[-1] - ordered[0] == len(ordered) - 1:
        return ((ordered[0], ordered[-1]),)
    out: list[tuple[int, int]] = []
    for n in ordered:
        if out and out[-1][1] == n - 1:
            out[-1] = (out[-1][0], n)
        else:
            out.append((n, n))
    return tuple(out)
