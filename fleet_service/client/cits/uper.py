"""Bits of unaligned PER: numbers in as many bits as their range needs, most significant first.
Pure.
"""

from __future__ import annotations


class BitWriter:
    """A run of bits that grows."""

    def __init__(self) -> None:
        self._bits = 0
        self._count = 0

    def write(self, value: int, width: int) -> None:
        """Append a number.

        Raises:
            OverflowError: it does not fit into the bits.
        """
        if value < 0 or value >> width:
            raise OverflowError(f"{value} does not fit into {width} bits")
        self._bits = self._bits << width | value
        self._count += width

    def to_bytes(self) -> bytes:
        """Return the bits, filled with zeros up to a whole byte."""
        spare = -self._count % 8
        return (self._bits << spare).to_bytes((self._count + spare) // 8, "big")
