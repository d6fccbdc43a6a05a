"""Simulated disk with power loss: while it is in use, power can fail at any file operation of the
code under test.

The files are real and lie in a folder. The code's operations on them are redirected to this module
(`os.fsync`, `os.rename`, `os.unlink`, `os.mkdir`, `os.rmdir`, `os.open`, `Path.open`,
`shutil.rmtree`). After power loss only synced data is certain: the bytes of a file at its last
fsync, and the names in a folder at the folder's last fsync. Any part of the later data may have
reached the disk. For bytes this is a prefix, with or without random bytes after it. For changes of
names it is any subset that keeps the order of the changes of each name.
"""

from __future__ import annotations

import errno
import io
import os
import random
import shutil
import stat
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

FOLDER = -1  # marks a folder, in place of the number of a file


class PowerLoss(BaseException):
    """Simulated power loss. Code under test must not catch this exception, and nothing is executed
    after it.
    """


class CrashDisk:
    """Simulated disk: the content of a folder that would survive a power loss.

    Args:
        live: folder of the disk's files; it is empty or was written by `write_image`.
        random_: random generator that chooses which unsynced data survives.
        power: number of operations until power is lost; None for no power loss.
        full: operations that fail because the disk is full, counted from 1.
    """

    def __init__(self, live: Path, random_: random.Random, power: int | None, full: range) -> None:
        self.live = live
        self._random = random_
        self._power = power
        self._full = full
        self.operations = 0
        # Number of each existing file by its inode. Inode numbers are reused, these numbers are
        # not.
        self._number: dict[int, int] = {}
        self._numbers = 0
        self._synced: dict[int, bytes] = {}
        self._written: dict[int, bytes] = {}  # content of files that no folder entry names
        self._names: dict[str, dict[str, int]] = {}
        self._later: dict[str, list[tuple[str, int | None]]] = defaultdict(list)
        for folder, folders, files in os.walk(live):
            self._names[folder] = dict.fromkeys(folders, FOLDER)
            for name in files:
                number = self._number_file(Path(folder) / name)
                self._names[folder][name] = number
                self._synced[number] = (Path(folder) / name).read_bytes()

    def _count_operation(self, *, needs_room: bool) -> None:
        self.operations += 1
        if self._power is not None and self.operations > self._power:
            raise PowerLoss
        if needs_room and self.operations in self._full:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def _number_file(self, path: Path) -> int:
        """Assign the next file number to a new file, and return it."""
        self._numbers += 1
        self._number[path.stat().st_ino] = self._numbers
        return self._numbers

    def _keep_content(self, path: Path) -> None:
        """Record a file's content as it was written, before the file is renamed, removed or
        replaced.
        """
        if path.is_file():
            self._written[self._number[path.stat().st_ino]] = path.read_bytes()

    def _is_ours(self, path: object) -> bool:
        return isinstance(path, (str, os.PathLike)) and Path(path).is_relative_to(self.live)

    def _record_change(self, path: str | os.PathLike[str], number: int | None) -> None:
        self._later[str(Path(path).parent)].append((Path(path).name, number))

    @contextmanager
    def intercept_calls(self) -> Iterator[None]:
        """Redirect all file operations on the folder to the simulated disk, for the duration of the
        `with` block.
        """
        calls: dict[str, Callable[..., Callable[..., object]]] = {
            "fsync": self._wrap_fsync,
            "rename": self._wrap_rename,
            "replace": self._wrap_rename,
            "open": self._wrap_open,
        }
        calls |= {
            "unlink": self._wrap_unlink,
            "remove": self._wrap_unlink,
            "mkdir": self._wrap_mkdir,
            "rmdir": self._wrap_unlink,
        }
        patches = [
            mock.patch.object(os, name, call(getattr(os, name))) for name, call in calls.items()
        ]
        patches.append(mock.patch.object(Path, "open", self._path_open(Path.open)))
        patches.append(mock.patch.object(shutil, "rmtree", _rmtree))
        for patch in patches:
            patch.start()
        try:
            yield
        finally:
            for patch in patches:
                patch.stop()

    def _wrap_fsync(self, real: Callable[[int], None]) -> Callable[[int], None]:
        def fsync(handle: int) -> None:
            path = Path(f"/proc/self/fd/{handle}").resolve()
            found = os.fstat(handle)
            if self._is_ours(path):
                self._count_operation(needs_room=not stat.S_ISDIR(found.st_mode))
                if stat.S_ISDIR(found.st_mode):
                    for name, number in self._later.pop(str(path), []):
                        _apply_change(self._names.setdefault(str(path), {}), name, number)
                else:
                    self._synced[self._number[found.st_ino]] = path.read_bytes()

        return fsync

    def _wrap_rename(self, real: Callable[..., None]) -> Callable[..., None]:
        def rename(source: Path, target: Path) -> None:
            if self._is_ours(source):
                self._count_operation(needs_room=False)
                self._keep_content(Path(target))
                self._record_change(source, None)
                if Path(source).is_dir():
                    self._move_names(str(source), str(target))
                    self._record_change(target, FOLDER)
                else:
                    self._record_change(target, self._number[Path(source).stat().st_ino])
            real(source, target)

        return rename

    def _move_names(self, source: str, target: str) -> None:
        """Record that a folder was renamed from `source` to `target`: everything that the simulated
        disk knows about its files and subfolders now belongs to the new name.
        """
        for path in [path for path in self._names if f"{path}/".startswith(f"{source}/")]:
            self._names[target + path.removeprefix(source)] = self._names[path].copy()
        for path in [path for path in self._later if f"{path}/".startswith(f"{source}/")]:
            self._later[target + path.removeprefix(source)] = self._later[path].copy()

    def _wrap_unlink(self, real: Callable[..., None]) -> Callable[..., None]:
        def unlink(path: Path, **more: object) -> None:
            if self._is_ours(path):
                self._count_operation(needs_room=False)
                self._keep_content(Path(path))
                real(path, **more)
                self._record_change(path, None)
            else:
                real(path, **more)

        return unlink

    def _wrap_mkdir(self, real: Callable[..., None]) -> Callable[..., None]:
        def mkdir(path: Path, *more: object, **named: object) -> None:
            if self._is_ours(path):
                self._count_operation(needs_room=True)
                real(path, *more, **named)
                self._names.pop(str(path), None)  # entries of a removed folder of the same name
                self._later.pop(str(path), None)
                self._record_change(path, FOLDER)
            else:
                real(path, *more, **named)

        return mkdir

    def _wrap_open(self, real: Callable[..., int]) -> Callable[..., int]:
        def open_(path: Path, flags: int, *more: object, **named: object) -> int:
            new = bool(flags & os.O_CREAT) and self._is_ours(path) and not Path(path).exists()
            if new:
                self._count_operation(needs_room=True)
            handle = real(path, flags, *more, **named)
            if new:
                self._record_change(path, self._number_file(Path(path)))
            return handle

        return open_

    def _path_open(self, real: Callable[..., object]) -> Callable[..., object]:
        disk = self

        class Raw(io.FileIO):
            # The code under test writes only bytes.
            def write(self, data: bytes) -> int:  # type: ignore[override]
                disk._count_operation(needs_room=True)
                return super().write(data)

        def open_(path: Path, mode: str = "r", *more: object, **named: object) -> object:
            if disk._is_ours(path) and "+" in mode:
                disk._count_operation(needs_room=True)
            if not disk._is_ours(path) or "w" not in mode:
                return real(path, mode, *more, **named)
            new = not path.exists()
            disk._count_operation(needs_room=new)
            raw = Raw(path, "w")
            if new:
                disk._record_change(path, disk._number_file(path))
            file = io.BufferedWriter(raw)  # type: ignore[type-var]  # for that reason
            return file if "b" in mode else io.TextIOWrapper(file, encoding="utf-8")

        return open_

    def write_image(self, target: Path) -> None:
        """Write into the folder `target` the files that a machine would find after a power loss at
        this moment.
        """
        paths = [Path(folder) / name for folder, _, files in os.walk(self.live) for name in files]
        numbered = {self._number.get(path.stat().st_ino): path for path in paths}
        written = {
            number: path.read_bytes() for number, path in numbered.items() if number is not None
        }
        self._write_folder_image(str(self.live), target, {**self._written, **written})

    def _write_folder_image(self, folder: str, target: Path, written: dict[int, bytes]) -> None:
        target.mkdir()
        names = dict(self._names.get(folder, {}))
        dropped: set[str] = set()
        for name, number in self._later.get(folder, []):
            if name not in dropped and self._random.random() < 0.5:
                _apply_change(names, name, number)
            else:
                # Later changes of the same name must not be applied before this one.
                dropped.add(name)
        for name, number in names.items():
            if number == FOLDER:
                self._write_folder_image(f"{folder}/{name}", target / name, written)
            else:
                (target / name).write_bytes(
                    self._draw_surviving(self._synced.get(number), written[number])
                )

    def _draw_surviving(self, synced: bytes | None, written: bytes) -> bytes:
        """Return a random possible content of a file after power loss. This is the synced content
        if nothing was written after it. Otherwise it is a prefix of the written content, and the
        rest may be random bytes.
        """
        if written == synced:
            return synced
        kept = written[: self._random.randint(0, len(written))]
        return kept + self._random.randbytes(len(written) - len(kept)) * self._random.randint(0, 1)


def _rmtree(path: Path, ignore_errors: bool = False) -> None:
    """Remove a folder tree like `shutil.rmtree`, but by path names instead of file descriptors."""
    try:
        for inner in sorted(Path(path).iterdir()):
            if inner.is_dir():
                _rmtree(inner)
            else:
                inner.unlink()
        Path(path).rmdir()
    except OSError:
        if not ignore_errors:
            raise


def _apply_change(names: dict[str, int], name: str, number: int | None) -> None:
    if number is None:
        names.pop(name, None)
    else:
        names[name] = number
