"""Compilation of numerical functions ("kernels") with numba; all packages compile them through this
module.
"""

from __future__ import annotations

import functools
import hashlib
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, ParamSpec, TypeVar, cast

import numba
from llvmlite import ir  # type: ignore[import-untyped]
from numba.core import cgutils, event, types
from numba.core.caching import FunctionCache
from numba.extending import intrinsic
from numpy.typing import NDArray

from schemas.runtime import progress_messages


class _Told(event.Listener):
    """Listener to events of numba that reports each compilation to the user, because it takes
    time.
    """

    def on_start(self, event: event.Event) -> None:
        """Report a compilation as the current activity, and once per process as a message."""
        progress_messages.report_once(progress_messages.COMPILING)
        progress_messages.set_status(f"compiling {event.data['dispatcher'].__name__}")

    def on_end(self, event: event.Event) -> None:
        """Do nothing; the listener interface requires this method."""


event.register("numba:compile", _Told())  # type: ignore[no-untyped-call]
LINE: Final = 64  # bytes that a processor reads at once

P = ParamSpec("P")
R = TypeVar("R")


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Compile `function` with numba: cached on disk, no fast-math, IEEE division (x/0 is inf, not
    an exception).

    Without fast-math and threads, the result for a row does not depend on the number of rows.
    Therefore a vehicle gets bit-equal results alone and among thousands. If the cache cannot be
    written, the function is compiled again at each start.
    """
    return _compile(function)


def inlined(function: Callable[P, R]) -> Callable[P, R]:
    """Compile `function` so that its code is copied into each caller. Use this for a few lines of
    arithmetic inside a loop, where a call would cost more than the arithmetic.

    The optimiser can then vectorise over the four wheels. Pass numbers and tuples rather than
    arrays: after each write to any array, the compiler must read array elements from memory again.
    """
    return _compile(function, forceinline=True)


def nogil(function: Callable[P, R]) -> Callable[P, R]:
    """Compile `function` so that it releases the interpreter lock (GIL) while it runs. Use this for
    long computations that access only their arguments.
    """
    return _compile(function, nogil=True)


def refcount_free(function: Callable[P, R]) -> Callable[P, R]:
    """Compile like `nogil`, but without counting references to arrays. Counting costs two locked
    additions per array and call.

    Use this only for functions that neither create nor return arrays, so that the caller owns all
    arrays. Functions that they call must be `refcount_free` too.
    """
    return _compile(function, nogil=True, references=False)


def refcount_free_inlined(function: Callable[P, R]) -> Callable[P, R]:
    """Compile like `refcount_free`, and copy the code into each caller as `inlined` does. An array
    argument is passed as seven machine words.
    """
    return _compile(function, nogil=True, forceinline=True, references=False)


# the types are Numba's own
def _prefetch(context: Any, array: Any, row: Any, line: Any) -> Any:  # noqa: ANN401, ARG001
    def generate(target: Any, builder: Any, signature: Any, values: Any) -> Any:  # noqa: ANN401
        kind = signature.args[0]
        long = ir.IntType(64)
        whole = ir.IntType(32)
        data = target.make_array(kind)(target, builder, values[0])
        place = [values[1], *[long(0)] * (kind.ndim - 1)]
        pointer = cgutils.get_item_pointer(  # type: ignore[no-untyped-call]
            target, builder, kind, data, place
        )
        begin = builder.ptrtoint(pointer, long)
        address = builder.inttoptr(
            builder.add(begin, builder.mul(values[2], long(LINE))), cgutils.voidptr_t
        )
        hint = ir.FunctionType(ir.VoidType(), [cgutils.voidptr_t, whole, whole, whole])
        function = cgutils.get_or_insert_function(  # type: ignore[no-untyped-call]
            builder.module, hint, "llvm.prefetch.p0"
        )
        # to read, into every cache, data
        builder.call(function, [address, whole(0), whole(3), whole(1)])
        return target.get_dummy_value()

    return types.void(array, types.int64, types.int64), generate


# `prefetch(array, row, line)` in compiled code: let a LINE of `array[row]` come meanwhile. For
# arrays of one or two dimensions; a hint, so that `row` may lie outside.
prefetch = cast(Callable[[NDArray[Any], Any, int], None], intrinsic(_prefetch))


def entry_point(kernel: Callable[P, R]) -> Callable[P, R]:
    """Return a callable that runs the machine code of a compiled function directly. It omits
    numba's check of the arguments, which costs 0.3 µs per call.

    The function must have been called before. Every argument must have the same type as in that
    call, because types are not checked again.
    """
    made = next(iter(kernel.overloads.values()))  # type: ignore[attr-defined]
    return cast(Callable[P, R], made.entry_point)


def _compile(
    function: Callable[P, R],
    *,
    nogil: bool = False,
    forceinline: bool = False,
    references: bool = True,
) -> Callable[P, R]:
    kept = "NUMBA_CACHE_DIR" in os.environ or cache_root() is not None
    if kept and "NUMBA_CACHE_DIR" not in os.environ:
        package = function.__module__.partition(".")[0]
        numba.config.CACHE_DIR = kernel_cache(package)  # type: ignore[attr-defined]
    options: dict[str, Any] = {"nogil": nogil, "forceinline": forceinline, "_nrt": references}
    kernel = numba.njit(cache=kept, error_model="numpy", **options)(function)
    if kept:
        kernel._cache = _Cache(function)  # type: ignore[no-untyped-call] # no public way
    return cast(Callable[P, R], kernel)


class _Cache(FunctionCache):
    """Numba's cache with two fixes: a full disk does not raise, and closures get stable keys."""

    def _index_key(self, sig: object, codegen: Any) -> object:  # noqa: ANN401 numba's own types
        """Return the cache key; for a closure it contains the names of the enclosed objects.
        Numba's own key for a closure differs in each process.
        """
        cells = self._py_func.__closure__
        if cells is None:
            return super()._index_key(sig, codegen)  # type: ignore[no-untyped-call]
        held = (cell.cell_contents for cell in cells)
        names = tuple(
            f"{getattr(one, '__module__', '')}.{getattr(one, '__qualname__', one)}" for one in held
        )
        return sig, codegen.magic_tuple(), (self._py_func.__code__.co_code, names)

    def save_overload(self, sig: object, data: object) -> None:
        """Save a function's compiled code in the cache; ignore errors of the disk."""
        with suppress(OSError):
            super().save_overload(sig, data)  # type: ignore[no-untyped-call]


@functools.cache
def kernel_cache(package: str) -> str:
    """Return the folder for a package's compiled functions, in the user's cache; a digest of all
    source files is part of its name.

    Numba's own cache checks only the source file of a function, not the files of the functions and
    constants that it uses. After a change there it would use outdated code. Old folders may be
    deleted at any time.
    """
    root = Path(__file__).parents[2]
    digest = hashlib.blake2b(digest_size=8)
    for folder in (root / "schemas", root / package):
        for path in sorted(folder.rglob("*.py")):
            digest.update(path.read_bytes())
    return str((cache_root() or Path()) / f"{package}-{digest.hexdigest()}")


@functools.cache
def cache_root() -> Path | None:
    """Return the folder for compiled functions: the user's cache folder, or else a folder of the
    user among the temporary files.

    Return None if neither can be written (a service account without a home folder, a read-only
    container). Functions are then compiled again at each start.
    """
    for folder in _roots():
        with suppress(OSError):
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            own = folder.stat()
            # what lies there is executed: nobody else may be able to put it there
            if (
                os.access(folder, os.W_OK | os.X_OK)
                and own.st_uid == os.getuid()
                and not own.st_mode & 0o002
            ):
                return folder
    return None


def _roots() -> Iterator[Path]:
    if given := os.environ.get("XDG_CACHE_HOME"):
        yield Path(given) / "gripmap"
    with suppress(RuntimeError):  # a user without a home
        yield Path.home() / ".cache" / "gripmap"
    with suppress(OSError):
        yield Path(tempfile.gettempdir()) / f"gripmap-{os.getuid()}"
