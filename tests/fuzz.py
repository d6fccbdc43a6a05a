"""Coverage-guided fuzzing of parsers: an input that runs new lines of code is stored and mutated
further.

    python -m tests.fuzz [--seconds 45] [--only NAME …] [--seed N] [--out .fuzz]

Each parser has committed seeds in `tests/data/fuzz/NAME/`, and a corpus in the folder `--out`. A
crash is any exception that the parser does not document; a hang is more than SLOW_S for one input.
Inputs that crash or hang are written next to the corpus. Copy useful new inputs to
`tests/data/fuzz`.
"""

from __future__ import annotations

import argparse
import functools
import hashlib
import random
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from types import CodeType, FrameType
from typing import Any, Final, NamedTuple, cast

from edge_agent.inputs.readers.dbc import parse_dbc
from edge_agent.inputs.readers.gnss import parse_gpsd, parse_nmea
from fleet_service.archive.format.version import parse_version
from fleet_service.ingest.batch_decoder import decode_many
from fleet_service.replay.checkpoints import load_checkpoint
from fleet_service.replication.bucket import CopyError, ObjectBucket
from fleet_service.replication.fence import fence_of
from fleet_service.replication.lease import _parse_record
from schemas import keys, query, weather, wire
from schemas.errors import InputError
from schemas.wire import Kind
from schemas.wire.tile import decode_tile
from tests.structure import ROOT

SEEDS: Final = ROOT / "tests" / "data" / "fuzz"
# Processor time that counts as a hang. An input of at most LONGEST bytes normally takes
# milliseconds.
SLOW_S: Final = 5.0
LONGEST: Final = 8192
CODE: Final = tuple(str(ROOT / name) for name in ("schemas", "edge_agent", "fleet_service"))
# Exceptions that the readers of lines catch.
GNSS_ERRORS: Final = (ValueError, TypeError, OverflowError, RecursionError)
WORDS: Final = (
    *(
        b"\x00",
        b"\xff",
        b"-1",
        b"1e308",
        b"nan",
        b"null",
        b'"',
        b"{",
        b"[",
        b":",
        b"|",
        b"@",
        b"*",
        b"/",
    ),
    b" " * 64,
)


class Parser(NamedTuple):
    """Parser to be fuzzed, and the exceptions that it may raise for invalid input according to its
    documentation.
    """

    parse: Callable[[bytes], object]
    allowed: tuple[type[Exception], ...] = (InputError,)


class Result(NamedTuple):
    """Result of fuzzing one parser: numbers of executions, stored inputs (corpus), executed lines,
    crashes and hangs.
    """

    executions: int
    corpus: int
    lines: int
    crashes: int
    hangs: int


def _decode_first(parse: Callable[[str], object]) -> Callable[[bytes], object]:
    return lambda data: parse(data.decode("utf-8", "replace"))


def _parse_query(data: bytes) -> object:
    pairs = (part.partition("=") for part in data.decode("utf-8", "replace").split(";"))
    return query.parse({name: value for name, _, value in pairs})


@functools.cache
def _folder() -> TemporaryDirectory[str]:
    return TemporaryDirectory()


def _load_manifest(data: bytes) -> object:
    path = Path(_folder().name, "0000000001-000000000001")
    path.mkdir(exist_ok=True)
    (path / "manifest.json").write_bytes(data)
    return load_checkpoint(path)


class _OneFence:
    """Simulated bucket that contains one fence object (list of a former owner's valid files)."""

    def __init__(self, content: bytes) -> None:
        self._content = content

    def list_names(self, _: str) -> list[str]:
        """Return the name of the only object in this bucket."""
        return ["fence/0000000001-000001.json.gz"]

    def get(self, _: str) -> bytes:
        """Return the content of the only object in this bucket."""
        return self._content


PARSERS: Final = {
    "observations": Parser(
        lambda data: decode_many(Kind.OBSERVATION, [(data, wire.ENCODING[Kind.OBSERVATION])])
    ),
    "states": Parser(lambda data: decode_many(Kind.STATE, [(data, wire.ENCODING[Kind.STATE])])),
    "json": Parser(lambda data: decode_many(Kind.OBSERVATION, [(data, wire.JSON)])),
    "acks": Parser(wire.decode_ack),
    "alerts": Parser(wire.decode_alert),
    "standing": Parser(wire.decode_standing),
    "tiles": Parser(decode_tile),
    "queries": Parser(_parse_query),
    "weather": Parser(lambda data: weather.decode_report(data, wire.JSON)),
    "keys": Parser(_decode_first(keys.parse)),
    "versions": Parser(_decode_first(parse_version)),
    "dbc": Parser(_decode_first(parse_dbc)),
    "nmea": Parser(_decode_first(parse_nmea), GNSS_ERRORS),
    "gpsd": Parser(_decode_first(parse_gpsd), GNSS_ERRORS),
    "leases": Parser(lambda data: _parse_record("lease/0000000001.json", data)),
    "checkpoints": Parser(_load_manifest),
    "fences": Parser(
        lambda data: fence_of(cast(ObjectBucket, _OneFence(data))), (InputError, CopyError)
    ),
}


class Fuzzer:
    """Fuzzer of one parser.

    Args:
        parser: the parser to fuzz.
        inputs: initial corpus.
        seed: seed of the random mutations.
        keep: function that stores an input; called with its kind (corpus, crash or hang) and
            content.
    """

    def __init__(
        self, parser: Parser, inputs: Sequence[bytes], seed: int, keep: Callable[[str, bytes], None]
    ) -> None:
        self._parser = parser
        self._keep = keep
        self._random = random.Random(seed)
        self._lines: set[tuple[CodeType, int, int]] = set()
        self._corpus: list[bytes] = []
        self._executions = 0
        self._crashes = 0
        self._hangs = 0
        for one in inputs or [b""]:
            self._run_input(one, always=True)

    def run(self, seconds: float = float("inf"), executions: float = float("inf")) -> Result:
        """Fuzz until `seconds` have passed or `executions` inputs have run. Return the run's
        counts.
        """
        end = time.monotonic() + seconds
        while self._executions < executions and time.monotonic() < end:
            self._run_input(self._mutate_input(self._random.choice(self._corpus)))
        return Result(
            self._executions, len(self._corpus), len(self._lines), self._crashes, self._hangs
        )

    def _run_input(self, data: bytes, *, always: bool = False) -> None:
        known = len(self._lines)
        began = time.process_time()
        self._executions += 1
        sys.settrace(self._trace_call)
        try:
            self._parser.parse(data)
        except self._parser.allowed:
            pass
        except Exception:  # noqa: BLE001 any other exception is a crash
            sys.settrace(None)
            self._crashes += 1
            self._keep("crash", data)
            traceback.print_exc()
        finally:
            sys.settrace(None)
        # The first inputs may compile kernels, so their time does not count.
        if not always and time.process_time() - began > SLOW_S:
            self._hangs += 1
            self._keep("hang", data)
        if always or len(self._lines) > known:
            self._corpus.append(data)
            self._keep("corpus", data)

    # `sys.settrace` requires this type.
    def _trace_call(self, frame: FrameType, event: str, _: Any) -> Any:  # noqa: ANN401
        if not frame.f_code.co_filename.startswith(CODE):
            return None
        before = 0

        def trace_line(inner: FrameType, _event: str, _arg: Any) -> Any:  # noqa: ANN401
            nonlocal before
            self._lines.add((inner.f_code, before, inner.f_lineno))
            before = inner.f_lineno
            return trace_line

        return trace_line

    def _mutate_input(self, data: bytes) -> bytes:
        r = self._random
        out = bytearray(data)
        for _ in range(r.choice((1, 1, 2, 4))):
            place = r.randrange(len(out) + 1)
            what = r.randrange(6)
            if what == 0 and out:
                out[place % len(out)] ^= 1 << r.randrange(8)
            elif what == 1:
                out[place:place] = r.choice(WORDS)
            elif what == 2:
                del out[place : place + r.randrange(1, 16)]
            elif what == 3:
                out[place:place] = out[place : place + r.randrange(1, 64)]
            elif what == 4:
                other = r.choice(self._corpus)
                out[place:] = other[r.randrange(len(other) + 1) :]
            else:
                out[place : place + 1] = bytes([r.randrange(256)])
        return bytes(out[:LONGEST])


def seeds_of(name: str) -> list[bytes]:
    """Return the initial inputs for fuzzing the parser of this name; they are files in the
    repository.
    """
    return [path.read_bytes() for path in sorted((SEEDS / name).glob("*"))]


def make_keeper(folder: Path) -> Callable[[str, bytes], None]:
    """Return a function that writes an input of the fuzzer as a file below `folder`. Equal inputs
    get the same file name, so each distinct input is stored once.
    """

    def write_input(kind: str, data: bytes) -> None:
        path = folder / kind / hashlib.sha256(data).hexdigest()[:16]
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)

    return write_input


def main() -> int:
    """Fuzz all parsers, or those of `--only`. Return 1 if an input crashed or hung, otherwise 0."""
    parser = argparse.ArgumentParser(
        prog="tests.fuzz", description="Coverage-guided fuzzing of parsers."
    )
    parser.add_argument("--seconds", type=float, default=45.0, help="for each parser (default 45)")
    parser.add_argument("--only", nargs="+", choices=PARSERS, help="these parsers alone")
    parser.add_argument("--seed", type=int, default=0, help="of the changes (default 0)")
    parser.add_argument(
        "--out", type=Path, default=Path(".fuzz"), help="corpus and findings (default .fuzz)"
    )
    args = parser.parse_args()
    bad = 0
    for name in args.only or PARSERS:
        kept = [path.read_bytes() for path in sorted((args.out / name / "corpus").glob("*"))]
        fuzzer = Fuzzer(
            PARSERS[name], [*seeds_of(name), *kept], args.seed, make_keeper(args.out / name)
        )
        found = fuzzer.run(args.seconds)
        print(f"{name}: {found}", flush=True)
        bad += found.crashes + found.hangs
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
