"""Filters in C as a lower limit for the time of an estimator: kernel.c for single filters,
kernel_simd.c for many filters side by side. They are compiled when the benchmark runs.
"""

from __future__ import annotations

import ctypes
import math
import subprocess
import tempfile
from functools import cache
from pathlib import Path

import numpy as np

from edge_agent.adaptation.memberships import Memberships
from edge_agent.estimators.common.output import PRIOR_MU_STD
from edge_agent.estimators.paper_aco_fckf import (
    LARGEST_FACTOR,
    LEAST_FACTOR,
    STEP_S,
    WINDOW_S,
    Setting,
)
from schemas.mugrid import LOWER, UPPER
from schemas.numeric import FloatArray

FOLDER = Path(__file__).parent
STATES = 6
ROWS = 3
WHEELS = 4
PARAMETERS = 12  # number of vehicle parameters that the C kernels read: the first of each row
FACTOR = STATES + STATES * STATES + ROWS * 2  # index of `factor` among the struct's doubles
# Options that let gcc vectorise square roots and selections. None of them changes a result.
VECTORS = ("-fno-math-errno", "-fno-trapping-math", "-fopenmp-simd", "-lmvec")


@cache
def compile_library(source: str, *options: str) -> ctypes.CDLL:
    """Compile a C file with gcc -O3 -march=native and `options`, and load it.

    Raises:
        OSError, subprocess.CalledProcessError: gcc is missing or fails.
    """
    target = Path(tempfile.mkdtemp()) / "kernel.so"
    words = [
        "gcc",
        "-O3",
        "-march=native",
        "-shared",
        "-fPIC",
        str(FOLDER / source),
        "-o",
        str(target),
    ]
    subprocess.run([*words, *options, "-lm"], check=True)
    return ctypes.CDLL(str(target))


def setting_row(memberships: Memberships) -> FloatArray:
    """Return all settings of the C filters as one array, in the order of the fields of the C
    structure `Setting`.
    """
    setting = Setting()
    return np.array(
        [
            *np.sqrt(setting.process),
            *setting.noise,
            *memberships.inputs,
            *memberships.outputs,
            LEAST_FACTOR,
            LARGEST_FACTOR,
            STEP_S,
            WINDOW_S,
            LOWER,
            UPPER,
            PRIOR_MU_STD,
        ]
    )


def first_memory(first: FloatArray, speed: float) -> FloatArray:
    """Return the initial state of N filters in C as an array (N, doubles). Each row has the layout
    of the C structure of one filter.

    Args:
        first: first readings (N, 11): ax, ay, yaw rate, steering angles delta and wheel speeds
            omega.
        speed: initial speed [m/s].
    """
    setting = Setting()
    (count, inputs) = first.shape
    turned = FACTOR + ROWS + inputs
    memory = np.zeros((count, turned + 2 * WHEELS))
    memory[:, 0] = speed
    memory[:, 2:5] = first[:, :3]
    memory[:, 5] = setting.mu
    for i in range(STATES):
        memory[:, STATES + i * STATES + i] = np.sqrt(setting.start[i])
    memory[:, FACTOR : FACTOR + ROWS] = 1.0
    memory[:, FACTOR + ROWS : turned] = first
    steering = first[:, ROWS : ROWS + WHEELS]
    memory[:, turned:] = np.concatenate([np.cos(steering), np.sin(steering)], axis=1)
    return memory


def pointer_to(array: FloatArray) -> ctypes.c_void_p:
    """Return the memory address of an array's data as a C pointer (void *)."""
    return ctypes.c_void_p(array.ctypes.data)


class CompiledFilters:
    """Set of filters in C: the loaded library, and the arrays that its functions read."""

    _library: ctypes.CDLL
    _memory: FloatArray
    _parameters: FloatArray
    _setting: FloatArray

    def _run_filters(self, readings: FloatArray, gone: float, out: FloatArray) -> None:
        """Run all filters over successive readings, which are `gone` seconds apart, and write the
        means of their states to `out`. The first two axes of `readings` are samples and filters (or
        blocks of filters).
        """
        samples, filters = readings.shape[:2]
        self._library.drive(
            pointer_to(self._memory),
            pointer_to(self._parameters),
            pointer_to(self._setting),
            pointer_to(readings),
            ctypes.c_double(gone),
            samples,
            filters,
            pointer_to(out),
        )


class Limit(CompiledFilters):
    """Set of N filters in C. Each filter has its own C structure, and all OpenMP threads share the
    work.
    """

    def __init__(
        self, parameters: FloatArray, first: FloatArray, speed: float, memberships: Memberships
    ) -> None:
        """Create the filters.

        Args:
            parameters: vehicle parameters (N, 12).
            first: first readings (N, 11): ax, ay, yaw rate, steering angles delta and wheel speeds
                omega.
            speed: initial speed [m/s].
            memberships: parameters of the fuzzy sets.
        """
        self._library = compile_library("kernel.c", "-fopenmp")
        self._parameters = np.ascontiguousarray(parameters)
        self._setting = setting_row(memberships)
        self._memory = first_memory(first, speed)

    def drive(self, readings: FloatArray, gone: float) -> FloatArray:
        """Run all filters over T successive sensor readings, (T, N, 11). The time between two
        readings is `gone` [s]. Return the mean of each filter's state after each reading,
        (T, N, 6).
        """
        samples, vehicles, _ = readings.shape
        out = np.empty((samples, vehicles, STATES))
        self._run_filters(readings, gone, out)
        return out


class VectorLimit(CompiledFilters):
    """Set of N filters in C, interleaved in SIMD vectors, on one thread. N must be a multiple of
    the vector length.
    """

    def __init__(
        self, parameters: FloatArray, first: FloatArray, speed: float, memberships: Memberships
    ) -> None:
        """Create N filters in C, one per vehicle.

        Args:
            parameters: vehicle parameters (N, 12).
            first: first readings (N, 11): ax, ay, yaw rate, steering angles delta and wheel speeds
                omega.
            speed: initial speed [m/s].
            memberships: parameters of the fuzzy sets.
        """
        self._library = compile_library("kernel_simd.c", *VECTORS)
        self._lanes = int(self._library.lanes())
        self._setting = setting_row(memberships)
        self._parameters = self.side_by_side(parameters)
        self._memory = self.side_by_side(first_memory(first, speed))

    def side_by_side(self, values: FloatArray) -> FloatArray:
        """Rearrange an array (..., N, K) of K values for each of N vehicles to (..., N/L, K, L),
        where L is the number of lanes of a SIMD vector. Each vector then holds one of the K values
        for L vehicles. Align the memory of the returned array to vectors.
        """
        *rest, vehicles, numbers = values.shape
        turned = values.reshape(*rest, vehicles // self._lanes, self._lanes, numbers).swapaxes(
            -1, -2
        )
        out = allocate_aligned(*turned.shape)
        out[...] = turned
        return out

    def drive(self, readings: FloatArray, gone: float) -> FloatArray:
        """Run all filters over T successive sensor readings, and return the mean of each filter's
        state after each reading, (T, N/L, 6, L). N is the number of vehicles, and L the number of
        lanes of a SIMD vector.

        Args:
            readings: readings (T, N/L, 11, L). The method `side_by_side` converts an array (T, N,
                11) to this shape.
            gone: time between two readings [s].
        """
        samples, blocks, _, lanes = readings.shape
        out = allocate_aligned(samples, blocks, STATES, lanes)
        self._run_filters(readings, gone, out)
        return out


def allocate_aligned(*shape: int, to: int = 64) -> FloatArray:
    """Return an uninitialised array whose data begins at a multiple of `to` bytes in memory."""
    count = math.prod(shape)
    raw = np.empty(8 * count + to, np.uint8)
    begin = -raw.ctypes.data % to
    return raw[begin : begin + 8 * count].view(np.float64).reshape(shape)
