"""Bit writer for unaligned PER (an ASN.1 encoding): each number takes only as many bits as its
range needs, most significant bit first. Pure (no I/O).
"""

from __future__ import annotations


class BitWriter:
    """Sequence of bits to which numbers are appended; used to encode a DENM (hazard message)."""

    def __init__(self) -> None:
        self._bits = 0
        self._count = 0

    def write(self, value: int, width: int) -> None:
        """Append a number as `width` bits.

        Raises:
            OverflowError: the number does not fit into the bits.
        """
        if value < 0 or value >> width:
            raise OverflowError(f"{value} does not fit into {width} bits")
        self._bits = self._bits << width | value
        self._count += width

    def to_bytes(self) -> bytes:
        """Return the bits as bytes; the last byte is filled with zeros."""
        spare = -self._count % 8
        return (self._bits << spare).to_bytes((self._count + spare) // 8, "big")
