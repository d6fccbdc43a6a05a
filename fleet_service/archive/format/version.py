"""Format version of an archive file and digest of its columns, both in the Parquet footer.

| version | change |
|---|---|
| 1.0 | The footer states no version and no digest. FIRST contains the digests of the columns. |
| 1.1 | The footer contains `gripmap.version` and `gripmap.digest`. |
| 1.2 | New columns: observations `value`; roll-up (hourly statistics) `value_count`, `value_sum`. |
|     | In the map, `mu` is null for cells of which only a lower bound is known. |
| 1.3 | New columns of the observations: `esc_active`, `tcs_active`, `wiper`. |
| 1.4 | New column of the states: `p_slippery`. |

A minor version adds columns: older readers ignore them, newer readers read null. A major version
changes the meaning of a column: older readers refuse the file.

The digest covers the names and types of the columns and the version, which Parquet's own checksums
do not cover. All versions compute the digest in the same way. Therefore a reader can verify the
digest before it uses the version: a damaged version is reported as damage.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import lru_cache
from hashlib import blake2b
from pathlib import Path
from typing import Final, NamedTuple

import pyarrow as pa

from schemas.errors import InputError


class Version(NamedTuple):
    """Version of the archive's file format: major and minor number."""

    major: int
    minor: int

    def __str__(self) -> str:
        return f"{self.major}.{self.minor}"


VERSION: Final = Version(1, 4)
OLDEST: Final = Version(1, 0)  # version of files that state no version
PREFIX: Final = "gripmap."
KEY: Final = PREFIX + "version"
DIGEST: Final = PREFIX + "digest"
_PREFIX: Final = PREFIX.encode()
# Digests of the columns of version 1.0: observations, states, map, roll-up, weather.
FIRST: Final = frozenset(
    {
        "b4e3f43b32a213b3",
        "1bfeb3d126375335",
        "6fe39bc9930a552b",
        "248504dd5bdebddb",
        "c7a993882fc20c55",
    }
)


class DamagedError(Exception):
    """Error for a damaged archive file: its content differs from the content that was written."""


def make_footer(schema: pa.Schema, entries: Mapping[str, str] | None = None) -> dict[str, str]:
    """Return the key-value pairs for the footer of an archive file: the pairs `entries`, the digest
    (checksum of the columns `schema`), and the current format version unless `entries` contains
    one.
    """
    own = {KEY: str(VERSION), **(entries or {})}
    own = {key: value for key, value in own.items() if key != DIGEST}
    return own | {DIGEST: schema_digest(schema, own)}


def entries_of(metadata: Mapping[bytes, bytes] | None) -> dict[str, str]:
    """Return those key-value pairs of a file's footer that GripMap wrote. Bytes that cannot be
    decoded are replaced; the digest then detects the damage.
    """
    return {
        key.decode(errors="replace"): value.decode(errors="replace")
        for key, value in (metadata or {}).items()
        if key.startswith(_PREFIX)
    }


def is_newer(entries: Mapping[str, str]) -> bool:
    """Return True if an archive file states a newer major version of the format. This is only a
    quick check; `check_version` decides.
    """
    return entries.get(KEY, "0").partition(".")[0] > str(VERSION.major)


def check_version(path: Path, schema: pa.Schema, entries: Mapping[str, str]) -> Version:
    """Check the columns of an archive file and the key-value pairs of its footer; return the file's
    format version.

    Raises:
        DamagedError: the columns or the key-value pairs are not those that were written.
        InputError: the file has a newer major version, or states no valid version.
    """
    if KEY not in entries and DIGEST not in entries:
        if schema_digest(schema, {}) not in FIRST:
            raise DamagedError(
                f"the columns are not those of version {OLDEST}, and the file states no other "
                f"version"
            )
        return OLDEST
    others = {key: value for key, value in entries.items() if key != DIGEST}
    if entries.get(DIGEST) != schema_digest(schema, others):
        raise DamagedError("the columns are not those that were written")
    found = parse_version(entries[KEY])
    if found.major > VERSION.major:
        raise InputError(
            "archive",
            f"{path} is of version {found}, and this GripMap reads {VERSION.major}.x",
            "use a newer GripMap",
        )
    return found


def parse_version(text: str) -> Version:
    """Return a format version from its text.

    Raises:
        InputError: the text is not of the form MAJOR.MINOR.
    """
    if re.fullmatch(r"[0-9]{1,6}\.[0-9]{1,6}", text) is None:
        raise InputError(
            "archive",
            f"version {text[:20]!r} is not MAJOR.MINOR",
            "use the GripMap that wrote the file",
        )
    major, minor = text.split(".")
    return Version(int(major), int(minor))


def schema_digest(schema: pa.Schema, entries: Mapping[str, str]) -> str:
    """Return a hash (16 hexadecimal digits) over names and types of a file's columns, and over the
    key-value pairs of its footer.
    """
    state = _hash_columns(tuple(schema.names), tuple(schema.types)).copy()
    for key in sorted(entries):
        state.update(f"\n{key}={entries[key]}".encode())
    return state.hexdigest()


@lru_cache(64)
def _hash_columns(names: tuple[str, ...], types: tuple[pa.DataType, ...]) -> blake2b:
    lines = (f"{name} {_type_name(kind)}" for name, kind in zip(names, types, strict=True))
    return blake2b("\n".join(lines).encode(), digest_size=8)


def _type_name(kind: pa.DataType) -> str:
    """Return the name of the type of a column. The name of a list's item differs between versions
    of Arrow and is omitted.
    """
    if pa.types.is_list(kind):
        return f"list<{_type_name(kind.value_type)}>"
    if pa.types.is_struct(kind):
        return f"struct<{', '.join(f'{f.name} {_type_name(f.type)}' for f in kind)}>"
    return str(kind)
