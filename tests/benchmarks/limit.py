"""The limit for an estimator: kernel.c, compiled when the benchmark runs, driven over the same samples."""

from __future__ import annotations

import ctypes
import subprocess
import tempfile
from functools import cache
from pathlib import Path

import numpy as np

from edge_agent.adaptation.memberships import Memberships
from edge_agent.estimators.gaussian.telling import PRIOR_MU_STD
from edge_agent.estimators.paper_aco_fckf import LARGEST_FACTOR, LEAST_FACTOR, STEP_S, WINDOW_S, Setting
from schemas.mugrid import LOWER, UPPER
from schemas.numeric import FloatArray

SOURCE = Path(__file__).with_name("kernel.c")
STATES, ROWS, WHEELS = 6, 3, 4
FACTOR = STATES + STATES * STATES + ROWS * 2  # place of `factor` in the struct's doubles


@cache
def library() -> ctypes.CDLL:
    """The kernel, by gcc -O3 -march=native -fopenmp.

    Raises:
        OSError, subprocess.CalledProcessError: there is no gcc, or it refuses.
    """
    target = Path(tempfile.mkdtemp()) / "kernel.so"
    words = ["gcc", "-O3", "-march=native", "-fopenmp", "-shared", "-fPIC", str(SOURCE), "-o", str(target), "-lm"]
    subprocess.run(words, check=True)
    return ctypes.CDLL(str(target))


class Limit:
    """N filters in C, at rest in `memory`, an array of their structs."""

    def __init__(self, parameters: FloatArray, first: FloatArray, memberships: Memberships) -> None:
        """parameters (N, 12); first (N, 11): ax, ay, yaw rate, delta, omega of the first sample."""
        self._library, self._parameters = library(), np.ascontiguousarray(parameters)
        setting = Setting()
        self._setting = np.array(
            [*np.sqrt(setting.process), *setting.noise, *memberships.inputs, *memberships.outputs,
             LEAST_FACTOR, LARGEST_FACTOR, STEP_S, WINDOW_S, LOWER, UPPER, PRIOR_MU_STD]
        )  # fmt: skip
        doubles = self._library.filter_bytes() // 8
        self.memory = np.zeros((len(parameters), doubles))
        self.memory[:, 2:5], self.memory[:, 5] = first[:, :3], setting.mu
        for i in range(STATES):
            self.memory[:, STATES + i * STATES + i] = np.sqrt(setting.start[i])
        self.memory[:, FACTOR : FACTOR + ROWS] = 1.0
        turned = FACTOR + ROWS + first.shape[1]
        self.memory[:, FACTOR + ROWS : turned] = first
        steering = first[:, ROWS : ROWS + WHEELS]
        self.memory[:, turned:] = np.concatenate([np.cos(steering), np.sin(steering)], axis=1)

    def begin(self, speed: FloatArray) -> None:
        """The first speed (N,) [m/s]."""
        self.memory[:, 0] = speed

    def drive(self, readings: FloatArray, gone: float) -> FloatArray:
        """Means (T, N, 6) after each of the readings (T, N, 11), `gone` [s] apart."""
        samples, vehicles, _ = readings.shape
        out = np.empty((samples, vehicles, STATES))
        pointer = ctypes.c_void_p
        self._library.drive(
            pointer(self.memory.ctypes.data), pointer(self._parameters.ctypes.data), pointer(self._setting.ctypes.data),
            pointer(readings.ctypes.data), ctypes.c_double(gone), samples, vehicles, pointer(out.ctypes.data),
        )  # fmt: skip
        return out
