"""Tests of the fuzzer: it must find a planted crash by coverage, and the committed seeds must crash
no parser.
"""

from __future__ import annotations

import pytest

from schemas.errors import InputError
from tests.fuzz import PARSERS, Fuzzer, Parser, seeds_of


def test_fuzzer_finds_a_planted_crash() -> None:
    def parse_planted(data: bytes) -> None:
        if data[:1] == b"{" and data[1:2] == b"|":
            raise KeyError("planted")
        raise InputError("data", "is not valid", "change it")

    found: list[tuple[str, bytes]] = []
    result = Fuzzer(
        Parser(parse_planted), [b"{x"], 0, lambda kind, data: found.append((kind, data))
    ).run(executions=20_000)
    assert result.crashes > 0
    assert any(kind == "crash" and data.startswith(b"{|") for kind, data in found)


@pytest.mark.parametrize("name", PARSERS)
def test_fuzz_seeds_cause_no_crash_and_no_hang(name: str) -> None:
    seeds = seeds_of(name)
    result = Fuzzer(PARSERS[name], seeds, 0, lambda kind, data: None).run(executions=50)
    assert (result.crashes, result.hangs) == (0, 0)
