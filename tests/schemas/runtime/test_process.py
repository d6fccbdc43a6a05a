"""Tests that errors of standard output never end a process."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

TALK = "import sys\nfrom schemas.runtime.logs import print_line\n"
TALK += "for _ in range(3): print_line('hello', sys.stderr)\nsys.exit(7)"


LEAVE = """
import atexit, threading
from schemas.runtime.process import exit_fast
class Held:
    def __del__(self):
        print("taken apart", flush=True)
held = Held()
atexit.register(print, "registered")
print("said", end=" ")
"""


def test_finished_command_exits_without_interpreter_teardown() -> None:
    done = subprocess.run(
        [sys.executable, "-c", f"{LEAVE}exit_fast(3)"], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (3, "said registered\n")


def test_a_thread_that_still_works_is_waited_for() -> None:
    words = f"""{LEAVE}
def work():
    while threading.main_thread().is_alive():  # until it waits
        pass
    print("worked")
threading.Thread(target=work).start()
exit_fast(3)"""
    done = subprocess.run(
        [sys.executable, "-c", words], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (3, "said worked\nregistered\n")


def test_a_full_disk_behind_the_output_does_not_end_the_process() -> None:
    with Path("/dev/full").open("w") as full:
        assert (
            subprocess.run([sys.executable, "-c", TALK], stderr=full, check=False).returncode == 7
        )
    completed = subprocess.run(
        [sys.executable, "-c", TALK], capture_output=True, text=True, check=False
    )
    assert completed.stderr == "hello\n" * 3


def test_arrow_reads_and_hands_out_numbers_where_pandas_is_kept_out() -> None:
    words = (
        "import sys; from schemas.runtime.process import limit_memory; limit_memory()\n"
        "import pyarrow as pa, numpy as np\n"
        "assert pa.array([1.5, None]).to_numpy(zero_copy_only=False)[0] == 1.5\n"
        "assert pa.array(np.array([2])).to_pylist() == [2]; assert 'pandas' not in sys.modules\n"
        "assert pa.default_memory_pool().backend_name == 'system'"
    )
    assert subprocess.run([sys.executable, "-W", "error", "-c", words], check=False).returncode == 0


def test_kernels_compile_without_optional_libraries() -> None:
    words = (
        "import sys; from schemas.runtime.process import trim_memory, limit_memory; "
        "limit_memory('scipy')\n"
        "import numpy as np; from fleet_service.fusion.normal import normal_cdf\n"
        "assert abs(normal_cdf(np.array([1.0]))[0] - 0.8413447) < 1e-6\n"
        "assert 'scipy' not in sys.modules and not np.zeros(1 << 20).any(); trim_memory()"
    )
    assert subprocess.run([sys.executable, "-W", "error", "-c", words], check=False).returncode == 0


MANY = """
import sys, threading
from schemas.runtime.logs import print_line
sys.setswitchinterval(1e-6)
def talk(who):
    for number in range(5000):
        print_line(f"{who} {number}", sys.stdout)
threads = [threading.Thread(target=talk, args=(who,)) for who in "abcd"]
[thread.start() for thread in threads]
[thread.join() for thread in threads]
"""


def test_lines_of_many_threads_stay_whole() -> None:
    done = subprocess.run([sys.executable, "-c", MANY], capture_output=True, text=True, check=True)
    assert sorted(done.stdout.splitlines()) == sorted(
        f"{who} {number}" for who in "abcd" for number in range(5000)
    )
