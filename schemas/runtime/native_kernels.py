"""Kernels of a shared library that was compiled before: they run without Numba and LLVM, which take
60 MB and half a second of a process.

Each function of the library is a kernel for certain types of arguments. Its only argument is a row
of 64-bit words: a mark that the kernel has completed, its result, and the parts of its arguments.
The types are part of the function's name. A call with other types uses the kernel's Numba version.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np

LINKER: Final = "cc"
HEADER: Final = 2  # words before the arguments: the mark, and the result
LARGEST: Final = 1 << 63


class OtherTypesError(TypeError):
    """The arguments have types that no native kernel takes."""


class Library:
    """Shared library of native kernels; `path` None: an empty library."""

    def __init__(self, path: Path | None) -> None:
        self._functions = None if path is None else ctypes.CDLL(os.fspath(path))

    def find_function(self, name: str) -> Callable[[Any], None] | None:
        """Return the function with the symbol `name`, or None."""
        return None if self._functions is None else getattr(self._functions, name, None)

    def call_missing(self, kernel: NativeKernel, arguments: tuple[Any, ...]) -> Any:  # noqa: ANN401
        """Call a kernel that the library lacks: run its Numba version, and return the result."""
        return kernel.numba_kernel(*arguments)


class NativeKernel:
    """Kernel that runs from a shared library, or, where that lacks it, by Numba."""

    def __init__(
        self,
        function: Callable[..., Any],
        library: Library,
        compile_with_numba: Callable[[], Callable[..., Any]],
    ) -> None:
        functools.update_wrapper(self, function)
        self.name = f"{function.__module__}.{function.__qualname__}"
        self._library = library
        self._compile = compile_with_numba
        self._found: dict[str, Callable[[Any], None] | None] = {}

    @functools.cached_property
    def numba_kernel(self) -> Callable[..., Any]:
        """The Numba version of the kernel; it is compiled at its first use."""
        return self._compile()

    def __call__(self, *arguments: Any) -> Any:  # noqa: ANN401 differs by kernel
        """Run the kernel, and return its result: None or an integer."""
        words = [0, 0]
        try:
            types = describe_type(arguments, words)
        except OtherTypesError:
            return self._library.call_missing(self, arguments)
        if types not in self._found:
            self._found[types] = self._library.find_function(symbol_of(self.name, types))
        function = self._found[types]
        if function is None:
            return self._library.call_missing(self, arguments)
        row = (ctypes.c_int64 * len(words))(*words)
        function(row)
        if not row[0]:
            raise ArithmeticError(f"{self.name}: the native kernel has failed")
        return row[1]


class NativeIntrinsic:
    """Intrinsic of Numba in a process that uses native kernels: Numba's own is loaded when Numba
    compiles a function that calls it.
    """

    def __init__(self, load: Callable[[], Any]) -> None:
        self._load = load

    @functools.cached_property
    def numba_intrinsic(self) -> Any:  # noqa: ANN401 the types are Numba's own
        """The intrinsic of Numba."""
        return self._load()


def symbol_of(name: str, types: str) -> str:
    """Return the symbol of the kernel `name` for arguments of the given types."""
    digest = hashlib.blake2b(f"{name}({types})".encode(), digest_size=16)
    return f"gripmap_{digest.hexdigest()}"


def describe_type(value: Any, words: list[int]) -> str:  # noqa: ANN401 whatever a kernel takes
    """Return the type of an argument as text, and append its parts to `words`.

    An array is its address and its shape, a tuple its elements, a number itself.

    Raises:
        OtherTypesError: the argument is neither a number nor a contiguous array that may be
            written, nor a tuple of these.
    """
    if isinstance(value, np.ndarray):
        flags = value.flags
        if not (flags.c_contiguous and flags.writeable and flags.aligned):
            raise OtherTypesError
        words.append(value.ctypes.data)
        words.extend(value.shape)
        return f"{_describe_element(value.dtype)}[{value.ndim}]"
    if isinstance(value, tuple):
        parts = ",".join([describe_type(part, words) for part in value])
        return f"{type(value).__qualname__}({parts})"
    if type(value) is float or type(value) is np.float64:
        words.append(struct.unpack("q", struct.pack("d", value))[0])
        return "float"
    if (type(value) is int or type(value) is np.int64) and -LARGEST <= value < LARGEST:
        words.append(int(value))
        return "int"
    raise OtherTypesError


@functools.cache
def _describe_element(kind: np.dtype[Any]) -> str:
    return kind.str if kind.names is None else repr(kind)
