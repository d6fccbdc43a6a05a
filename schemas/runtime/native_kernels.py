"""Kernels (compiled numerical functions) that are taken from a shared library, which was compiled
before the program was started. They run without Numba and LLVM, whose import takes 60 MB and half a
second.

Each function of the library is one kernel for fixed types of arguments; the types are part of the
function's name. Its only argument is the address of an array of 64-bit words. These are a mark that
the kernel has completed (DONE, or DONE_FLOAT if its result is a float), its result, and then the
parts of its arguments. For a call with other types, Numba compiles the kernel.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import struct
from array import array
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np

LINKER: Final = "cc"
HEADER: Final = 2  # words before the arguments: success mark and result
DONE: Final = 1
DONE_FLOAT: Final = 2
# Place of the address of an array's data in the array's Python object, [bytes]. The stable binary
# interface of NumPy (`PyArrayObject`) puts it directly behind the head of the object.
DATA_OFFSET: Final = object.__basicsize__
LARGEST: Final = 1 << 63


class OtherTypesError(TypeError):
    """Error: an argument of a call has a type that no kernel of a shared library accepts."""


class Library:
    """Shared library of kernels; if `path` is None, the library contains no functions."""

    def __init__(self, path: Path | None) -> None:
        # PyDLL keeps the interpreter lock (GIL) during a call; CDLL releases it.
        kinds = (ctypes.PyDLL, ctypes.CDLL)
        self._functions = [None if path is None else kind(os.fspath(path)) for kind in kinds]

    def find_function(self, name: str, *, nogil: bool) -> Callable[[int], None] | None:
        """Return the library's function with the symbol `name`, or None if the library does not
        contain it. Its argument is an address. With `nogil`, it releases the interpreter lock.
        """
        function = getattr(self._functions[nogil], name, None)
        if function is not None:
            function.argtypes = [ctypes.c_void_p]
            function.restype = None
        return function

    def call_missing(self, kernel: NativeKernel, arguments: tuple[Any, ...]) -> Any:  # noqa: ANN401
        """Run the Numba version of a kernel that the library does not contain, and return the
        result.
        """
        return kernel.numba_kernel(*arguments)


class NativeKernel:
    """Kernel (compiled numerical function) that runs from the shared library, or is compiled by
    Numba if the library does not contain it for the types of the arguments.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        library: Library,
        compile_with_numba: Callable[[], Callable[..., Any]],
        *,
        nogil: bool,
    ) -> None:
        functools.update_wrapper(self, function)
        self.name = f"{function.__module__}.{function.__qualname__}"
        self._library = library
        self._nogil = nogil
        self._compile = compile_with_numba
        self._native_functions: dict[str, Callable[[int], None] | None] = {}

    @functools.cached_property
    def numba_kernel(self) -> Callable[..., Any]:
        """Return the Numba version of the kernel; Numba compiles it at its first call."""
        return self._compile()

    def __call__(self, *arguments: Any) -> Any:  # noqa: ANN401 the type depends on the kernel
        """Run the kernel, and return its result: a number, or 0 if the kernel returns nothing."""
        words = [0, 0]
        try:
            types = describe_type(arguments, words)
        except OtherTypesError:
            return self._library.call_missing(self, arguments)
        if types not in self._native_functions:
            symbol = symbol_of(self.name, types)
            self._native_functions[types] = self._library.find_function(symbol, nogil=self._nogil)
        function = self._native_functions[types]
        if function is None:
            return self._library.call_missing(self, arguments)
        row = array("q", words)
        function(row.buffer_info()[0])
        if not row[0]:
            raise ArithmeticError(f"{self.name}: the native kernel has failed")
        if row[0] == DONE_FLOAT:
            return struct.unpack("d", struct.pack("q", row[1]))[0]
        return row[1]


class NativeIntrinsic:
    """Placeholder for a Numba intrinsic (function whose LLVM code this project generates itself) in
    a process that uses native kernels. Because of the placeholder, such a process imports Numba
    only when it must compile a function.
    """

    def __init__(self, load: Callable[[], Any]) -> None:
        self._load = load

    @functools.cached_property
    def numba_intrinsic(self) -> Any:  # noqa: ANN401 Numba has no types
        """Return the Numba intrinsic itself, and load it if necessary."""
        return self._load()


def symbol_of(name: str, types: str) -> str:
    """Return the symbol of a kernel in the shared library. The symbol is made from the kernel's
    name and the types of its arguments, both given as text.
    """
    digest = hashlib.blake2b(f"{name}({types})".encode(), digest_size=16)
    return f"gripmap_{digest.hexdigest()}"


def describe_type(value: Any, words: list[int]) -> str:  # noqa: ANN401 any argument of a kernel
    """Return the type of `value`, an argument of a kernel, as text. Append the 64-bit words that
    represent the argument to the list `words`.

    An array is represented by the address of its Python object (see DATA_OFFSET) and its shape, a
    tuple by the words of its elements, and a number or truth value by one word.

    Raises:
        OtherTypesError: the argument is neither a number, nor a truth value, nor a contiguous
            array, nor a tuple of these.
    """
    if isinstance(value, tuple):
        parts = ",".join([describe_type(part, words) for part in value])
        return f"{type(value).__qualname__}({parts})"
    if isinstance(value, np.ndarray):
        shape = value.shape
        words.append(id(value))
        words.extend(shape)
        flags = value.flags
        if flags.carray:  # contiguous, aligned and writeable
            return _describe_array(value.dtype, len(shape))
        if flags.c_contiguous and flags.aligned:
            return f"{_describe_array(value.dtype, len(shape))} read-only"
        raise OtherTypesError
    if type(value) is float or type(value) is np.float64:
        words.append(struct.unpack("q", struct.pack("d", value))[0])
        return "float"
    if (type(value) is int or type(value) is np.int64) and -LARGEST <= value < LARGEST:
        words.append(int(value))
        return "int"
    if type(value) is bool:
        words.append(value)
        return "bool"
    raise OtherTypesError


@functools.cache
def _describe_array(kind: np.dtype[Any], dimensions: int) -> str:
    element = kind.str
    if kind.names is not None:
        element = hashlib.blake2b(repr(kind).encode(), digest_size=8).hexdigest()
    return f"{element}[{dimensions}]"
