"""Tests of work in a child process with a copy of the memory: it must see the memory as it was at
the start, and its errors must arrive.
"""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from schemas.runtime.forked import run_forked
from tests.waiting import until

PARENT = """
import os, sys, time
from pathlib import Path
from schemas.runtime.forked import run_forked
run_forked(lambda: (Path(sys.argv[1]).write_text(str(os.getpid())), time.sleep(300)))
while not Path(sys.argv[1]).exists() or not Path(sys.argv[1]).read_text():
    time.sleep(0.01)
"""


def test_forked_work_uses_the_memory_at_its_start(tmp_path: Path) -> None:
    numbers = np.arange(100_000)
    expected = numbers.copy()
    working = run_forked(lambda: np.save(tmp_path / "numbers.npy", numbers))
    numbers[:] = 0
    working.wait()
    np.testing.assert_array_equal(np.load(tmp_path / "numbers.npy"), expected)


def test_an_error_of_the_work_is_raised_with_its_file() -> None:
    def fill_disk() -> None:
        raise OSError(errno.ENOSPC, "No space left on device", "cells.arrow")

    with pytest.raises(OSError, match="No space left") as raised:
        run_forked(fill_disk).wait()
    assert (raised.value.errno, raised.value.filename) == (errno.ENOSPC, "cells.arrow")


def test_a_killed_child_process_is_an_error() -> None:
    def end() -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    with pytest.raises(ChildProcessError, match="-9"):
        run_forked(end).wait()


def test_the_work_ends_with_its_parent(tmp_path: Path) -> None:
    mark = tmp_path / "pid"
    subprocess.run([sys.executable, "-c", PARENT, str(mark)], check=True)
    number = int(mark.read_text())
    until(lambda: not Path(f"/proc/{number}").exists() or is_ended(number))


def is_ended(number: int) -> bool:
    """Return True if a process has ended and only its exit code is left."""
    return Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
