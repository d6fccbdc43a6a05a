"""Compilation of kernels (numerical functions) by Numba, with its cache of compiled functions on
disk.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from typing import Any, ParamSpec, TypeVar, cast

import llvmlite.binding as llvm  # type: ignore[import-untyped]
import numba
from numba.core import event, types
from numba.core.caching import FunctionCache
from numba.core.registry import cpu_target
from numba.extending import typeof_impl

from schemas.runtime import progress_messages
from schemas.runtime.native_kernels import NativeIntrinsic, NativeKernel
from schemas.runtime.records import LANES

# LLVM turns a loop into vector instructions only if it has not unrolled the loop before, so a loop
# of four vectors or more must not be unrolled completely.
llvm.set_option("gripmap", f"-unroll-full-max-count={4 * LANES - 1}")

P = ParamSpec("P")
R = TypeVar("R")


class _CompilationListener(event.Listener):
    """Listener to events of numba. It reports each compilation to the user, because a compilation
    takes seconds.
    """

    def on_start(self, event: event.Event) -> None:
        """Show the user that a function is being compiled: set the spinner's text, and print a
        message at the first compilation in this process.
        """
        progress_messages.report_once(progress_messages.COMPILING)
        progress_messages.set_status(f"compiling {event.data['dispatcher'].__name__}")

    def on_end(self, event: event.Event) -> None:
        """Do nothing; the listener interface requires this method."""


event.register("numba:compile", _CompilationListener())  # type: ignore[no-untyped-call]


@typeof_impl.register(NativeKernel)
def _typeof_native_kernel(kernel: NativeKernel, _: object) -> types.Dispatcher:
    """Let functions that Numba compiles call a native kernel (function from a shared library).
    Numba asks for the type of `kernel`; return that of the kernel's Numba version, so that the call
    uses this version.
    """
    dispatcher: Any = kernel.numba_kernel
    return types.Dispatcher(dispatcher)


@typeof_impl.register(NativeIntrinsic)
def _typeof_native_intrinsic(placeholder: NativeIntrinsic, _: object) -> types.Type:
    """Let functions that Numba compiles call an intrinsic (function whose LLVM code this project
    generates itself). Numba asks for the type of `placeholder`; return that of the intrinsic, which
    is loaded now if necessary.
    """
    intrinsic = placeholder.numba_intrinsic
    for context in (cpu_target.typing_context, cpu_target.target_context):
        context.refresh()
    typing: Any = cpu_target.typing_context
    kind: types.Type = typing.resolve_value_type(intrinsic)
    return kind


def make_kernel(
    function: Callable[P, R], cache: str | None, options: dict[str, Any]
) -> Callable[P, R]:
    """Compile `function` with Numba's `options`: cached in the folder `cache`, no fast-math, IEEE
    division.
    """
    if cache is not None and "NUMBA_CACHE_DIR" not in os.environ:
        numba.config.CACHE_DIR = cache  # type: ignore[attr-defined]
    kernel = numba.njit(cache=cache is not None, error_model="numpy", **options)(function)
    if cache is not None:
        kernel._cache = _Cache(function)  # type: ignore[no-untyped-call] # no public way
    return cast(Callable[P, R], kernel)


class _Cache(FunctionCache):
    """Numba's cache of compiled functions with two changes: a full disk raises no error, and the
    key of a closure is the same in each process.
    """

    def _index_key(self, sig: object, codegen: Any) -> object:  # noqa: ANN401 Numba has no types
        """Return the key under which a function's compiled code is cached. For a closure the key
        contains the names of the enclosed objects, because Numba's own key differs in each process.
        """
        cells = self._py_func.__closure__
        if cells is None:
            return super()._index_key(sig, codegen)  # type: ignore[no-untyped-call]
        enclosed = (cell.cell_contents for cell in cells)
        names = tuple(
            f"{getattr(one, '__module__', '')}.{getattr(one, '__qualname__', one)}"
            for one in enclosed
        )
        return sig, codegen.magic_tuple(), (self._py_func.__code__.co_code, names)

    def save_overload(self, sig: object, data: object) -> None:
        """Save a function's compiled code in the cache; ignore errors of writing to disk."""
        with suppress(OSError):
            super().save_overload(sig, data)  # type: ignore[no-untyped-call]
