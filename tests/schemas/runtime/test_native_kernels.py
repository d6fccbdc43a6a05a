"""Tests of shared libraries of kernels (compiled functions). A library must give the results of
Numba. Calls that it cannot serve must be left to Numba or refused.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from schemas.runtime.native_kernels import OtherTypesError, describe_type

KERNELS = """import sys
from typing import NamedTuple
import numpy as np
from schemas.runtime.jit import compiled, nogil, refcount_free

class Pair(NamedTuple):
    values: object
    factor: float

@compiled
def halve(x):
    return 0.5 * x

@nogil
def add_all(out, pair, counts):
    total, (first, last) = 0, counts
    for i in range(first, last):
        out[i] += pair.factor * halve(pair.values[i])
        total += i
    return total

@compiled
def refuse(x):
    if x < 0:
        raise ValueError("negative")
    return x

@refcount_free
def mean(x, doubled):
    total = 0.0
    for i in range(len(x)):
        total += x[i]
    return (2.0 if doubled else 1.0) * total / len(x)

@compiled
def bounds(x):
    return x[0], x[-1]

@compiled
def fill(x):
    copy = np.empty(len(x))
    for i in range(len(x)):
        copy[i] = 2.0 * x[i]
    for i in range(len(x)):
        x[i] = copy[i]

def call_kernels():
    out, values = np.zeros(4), np.arange(4.0)
    print(add_all(out, Pair(values, 3.0), (1, 4)), out.tolist(), refuse(1))
    try:
        print(refuse(-1))
    except (ArithmeticError, ValueError) as error:
        print(type(error).__name__)
    fixed = np.arange(4.0)
    fixed.flags.writeable = False
    print(mean(fixed, True), mean(values, False))
    print("numba" in sys.modules)
    print(bounds(values))
    print(add_all(out, Pair(values[::-1], 3.0), (1, 4)), out.tolist(), "numba" in sys.modules)
"""
BUILD = """import sys, numpy as np
from pathlib import Path
from schemas.runtime.jit import use_native_kernels
from schemas.runtime.native_build import CallRecorder, build_library
recorder = CallRecorder()
use_native_kernels(recorder)
import kernels
kernels.add_all(np.zeros(4), kernels.Pair(np.zeros(4), 1.0), (0, 4))
kernels.refuse(1)
fixed = np.zeros(4)
fixed.flags.writeable = False
kernels.mean(fixed, True)
kernels.mean(np.zeros(4), True)
kernels.bounds(np.zeros(4))
build_library(recorder, Path(sys.argv[1]))
"""
USE = """import sys
from pathlib import Path
from schemas.runtime.jit import use_native_kernels
from schemas.runtime.native_kernels import Library
use_native_kernels(Library(Path(sys.argv[1])))
import kernels
kernels.call_kernels()
"""


def run_python(folder: Path, code: str, *words: str) -> list[str]:
    """Run Python code with the arguments `words` in a process that can import the test's module
    `kernels`. Return the lines that it prints.
    """
    root = Path(__file__).parents[3]
    environment = os.environ | {
        "PYTHONPATH": f"{folder}{os.pathsep}{root}",
        "NUMBA_CACHE_DIR": str(folder / "cache"),
    }
    done = subprocess.run(
        [sys.executable, "-c", code, *words],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.splitlines()


def test_a_library_runs_kernels_without_numba(tmp_path: Path) -> None:
    """The library must run kernels (compiled functions) without importing Numba, and must return
    the same results as Numba. An exception in a kernel must be raised as ArithmeticError. Numba
    must run calls for which the library has no kernel. Here these are a function that returns a
    tuple, and a call with an array that is not contiguous.
    """
    (tmp_path / "kernels.py").write_text(KERNELS)
    library = str(tmp_path / "library.so")
    run_python(tmp_path, BUILD, library)
    result = "6 [0.0, 1.5, 3.0, 4.5] 1"
    assert run_python(tmp_path, USE, library) == [
        result,
        "ArithmeticError",
        "3.0 1.5",
        "False",
        "(0.0, 3.0)",
        "6 [0.0, 4.5, 4.5, 4.5] True",
    ]
    by_numba = run_python(tmp_path, "import kernels; kernels.call_kernels()")
    assert by_numba[:2] == [result, "ValueError"]


def test_a_kernel_that_allocates_memory_is_refused(tmp_path: Path) -> None:
    """A library has no memory management of Numba. So the build of a library with a kernel that
    allocates an array must fail, and its message must tell what to do.
    """
    (tmp_path / "kernels.py").write_text(KERNELS)
    code = BUILD.replace("kernels.refuse(1)", "kernels.fill(np.zeros(4))")
    with pytest.raises(subprocess.CalledProcessError) as failed:
        run_python(tmp_path, code, str(tmp_path / "library.so"))
    assert "fill allocates memory: pass the array as an argument" in failed.value.stderr
    assert not (tmp_path / "library.so").exists()


def test_types_are_distinguished_and_parts_become_words() -> None:
    words: list[int] = []
    array = np.zeros((2, 3))
    kind = describe_type((array, (1, 2.0), True), words)
    assert kind == "tuple(<f8[2],tuple(int,float),bool)"
    assert words == [id(array), 2, 3, 1, 1 << 62, 1]


@pytest.mark.parametrize("value", [np.zeros((2, 2)).T[:1], np.zeros(4)[::2], "text", 1 << 63])
def test_value_without_a_library_type_is_refused(value: object) -> None:
    with pytest.raises(OtherTypesError):
        describe_type(value, [])


def test_an_array_that_must_not_be_written_has_a_type_of_its_own() -> None:
    array = np.zeros(2)
    array.flags.writeable = False
    assert describe_type((array, np.zeros(2)), []) == "tuple(<f8[1] read-only,<f8[1])"
