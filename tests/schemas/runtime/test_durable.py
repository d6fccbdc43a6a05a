"""Tests of durable writing. A file must be complete or unchanged at any time, also after a power
loss, and must have its permissions from the first byte on.
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from schemas.runtime.durable import draft_of, make_folder, open_durably


def test_a_file_has_its_name_when_it_is_whole_and_synced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    order: list[str] = []
    fsync = os.fsync
    rename = Path.rename

    def seen_fsync(handle: int) -> None:
        order.append("folder" if Path(f"/proc/self/fd/{handle}").is_dir() else "file")
        fsync(handle)

    def seen_rename(path: Path, target: Path) -> Path:
        order.append("name")
        return rename(path, target)

    monkeypatch.setattr(os, "fsync", seen_fsync)
    monkeypatch.setattr(Path, "rename", seen_rename)
    path = tmp_path / "a"
    with open_durably(path) as file:
        file.write(b"one")
        assert not path.exists()
    assert order == ["file", "name", "folder"]
    with open_durably(path, named=False) as file:
        file.write(b"two")
    assert order[3:] == ["file", "name"]
    assert (path.read_bytes(), [p.name for p in tmp_path.iterdir()]) == (b"two", ["a"])


@pytest.mark.parametrize("error", [OSError(28, "full"), KeyboardInterrupt(), ValueError()])
def test_failed_write_leaves_the_file_unchanged(tmp_path: Path, error: BaseException) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"old")

    def write_half() -> None:
        with open_durably(path) as file:
            file.write(b"new")
            raise error

    with pytest.raises(type(error)):
        write_half()
    assert (path.read_bytes(), [p.name for p in tmp_path.iterdir()]) == (b"old", ["a"])


def test_a_secret_is_never_readable_by_others_even_in_a_draft(tmp_path: Path) -> None:
    path = tmp_path / "key"
    draft_of(path).write_bytes(b"of a process that died, open to all")
    with open_durably(path, 0o600) as file:
        assert os.fstat(file.fileno()).st_mode & 0o777 == 0o600
    assert path.stat().st_mode & 0o777 == 0o600


def test_a_folder_is_made_with_those_above_it(tmp_path: Path) -> None:
    make_folder(tmp_path / "a" / "b" / "c")
    make_folder(tmp_path / "a" / "b" / "c")
    assert (tmp_path / "a" / "b" / "c").is_dir()
