"""Decorators that compile numerical functions ("kernels"); all packages compile them through this
module.

A kernel is compiled by Numba, or, in a process that has called `use_native_kernels`, taken from a
shared library that was compiled before. Such a process loads no compiler.
"""

from __future__ import annotations

import functools
import hashlib
import os
import platform
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Final, ParamSpec, TypeVar, cast

from schemas.runtime.native_kernels import Library, NativeIntrinsic, NativeKernel

HALVES: Final = ("edge_agent", "fleet_service")  # packages that do not use each other
LINE: Final = 64  # [bytes] size of a cache line
# Fields of /proc/cpuinfo that decide which instructions LLVM uses.
PROCESSOR: Final = ("vendor_id", "cpu family", "model", "flags", "CPU", "Features")

P = ParamSpec("P")
R = TypeVar("R")


class _Native:
    """Shared library from which this process takes its kernels (compiled numerical functions). If
    `library` is None, Numba compiles all kernels.
    """

    library: Library | None = None


def use_native_kernels(library: Library) -> None:
    """From now on, give each newly imported module its kernels from the shared library `library`.
    If the library lacks a kernel, Numba compiles that kernel at its first call.
    """
    _Native.library = library


def uses_native_kernels() -> bool:
    """Return True if this process takes its kernels from a shared library."""
    return _Native.library is not None


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Compile `function` with numba: cached on disk, no fast-math, IEEE division (x/0 is inf, not
    an exception).

    Without fast-math and threads, the result for one row of an array does not depend on the number
    of rows. Therefore a vehicle gets bit-equal results whether it is processed alone or among
    thousands. If the cache cannot be written, the function is compiled again at each start.
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
    """Compile `function` like `nogil` (without interpreter lock), and without counting references
    to arrays. Counting costs two locked additions per array and call.

    Use this only for functions that neither create nor return arrays, so that the caller owns all
    arrays. Functions that they call must be `refcount_free` too.
    """
    return _compile(function, nogil=True, references=False)


def refcount_free_locked(function: Callable[P, R]) -> Callable[P, R]:
    """Compile `function` without counting references to arrays, like `refcount_free`, but keep the
    interpreter lock (GIL). Use this for short functions: another thread may take the lock as soon
    as it is free, and waiting for it again may take longer than the function.
    """
    return _compile(function, references=False)


def refcount_free_inlined(function: Callable[P, R]) -> Callable[P, R]:
    """Compile `function` without counting references to arrays, like `refcount_free`, and copy its
    code into each caller, as `inlined` does. Pass few arrays: an array argument is passed as seven
    machine words.
    """
    return _compile(function, nogil=True, forceinline=True, references=False)


def load_intrinsic(module: str, name: str) -> object:
    """Return the Numba intrinsic (function whose LLVM code this project generates itself) that is
    defined by the attribute `name` of `module`. In a process with native kernels, return a
    placeholder instead, so that Numba is not imported before it is needed.
    """

    def load_with_numba() -> object:
        from numba.extending import intrinsic

        return intrinsic(getattr(import_module(module), name))

    return load_with_numba() if _Native.library is None else NativeIntrinsic(load_with_numba)


def entry_point(kernel: Callable[P, R]) -> Callable[P, R]:
    """Return a callable that runs the machine code of a compiled function directly. The callable
    omits numba's check of argument types, which costs 0.3 µs per call.

    The function must have been called before. Every argument must have the same type as in that
    call, because types are not checked again.
    """
    if isinstance(kernel, NativeKernel):
        return cast(Callable[P, R], kernel)
    compiled_kernel = next(iter(kernel.overloads.values()))  # type: ignore[attr-defined]
    return cast(Callable[P, R], compiled_kernel.entry_point)


def _compile(
    function: Callable[P, R],
    *,
    nogil: bool = False,
    forceinline: bool = False,
    references: bool = True,
) -> Callable[P, R]:
    options = {"nogil": nogil, "forceinline": forceinline, "_nrt": references}

    def compile_with_numba() -> Callable[P, R]:
        from schemas.runtime.numba_kernels import make_kernel

        cache = _cache_of(function.__module__.partition(".")[0])
        return make_kernel(function, cache, options)

    library = _Native.library
    if library is None:
        return compile_with_numba()
    return cast(Callable[P, R], NativeKernel(function, library, compile_with_numba, nogil=nogil))


def _cache_of(package: str) -> str | None:
    """Return the folder in which a package's compiled functions are cached, or None if no such
    folder can be written.
    """
    if given := os.environ.get("NUMBA_CACHE_DIR"):
        return given
    return None if cache_root() is None else kernel_cache(package)


def native_library_path(package: str) -> Path | None:
    """Return the path of the shared library with a package's kernels, in the package's cache
    folder. The name contains digests of all source files and of the processor's features. Return
    None if the cache cannot be written.
    """
    given = os.environ.get("NUMBA_CACHE_DIR")
    folder = Path(given) if given else cache_root()
    name = f"{describe_sources(package)}-{_processor_digest()}.so"
    return None if folder is None else folder / name


def _processor_digest() -> str:
    """Return a digest of the processor's model and features, on which compiled machine code
    depends.
    """
    lines = {platform.machine(), *list_processor_lines()}
    return hashlib.blake2b("\n".join(sorted(lines)).encode(), digest_size=4).hexdigest()


def list_processor_lines() -> list[str]:
    """Return the lines of /proc/cpuinfo that state the first processor's model and features. The
    list is empty on systems without this file.
    """
    try:
        first, _, _ = Path("/proc/cpuinfo").read_text().partition("\n\n")
    except OSError:
        return []
    return [line for line in first.splitlines() if line.startswith(PROCESSOR)]


def kernel_cache(package: str) -> str:
    """Return the folder in the user's cache for a package's compiled functions. The folder's name
    contains a digest of the source files, so that each version of the sources has a folder of its
    own. Folders of older versions may be deleted at any time.
    """
    return str((cache_root() or Path()) / describe_sources(package))


@functools.cache
def describe_sources(package: str) -> str:
    """Return a package's name with a digest of all source files on which its kernels depend.

    The digest is needed because Numba's own cache checks only the source file of a function. After
    a change in another file whose functions or constants it uses, Numba would take outdated code
    from its cache. A package that is not one of HALVES (tests, an installed estimator) may use
    both.
    """
    root = Path(__file__).parents[2]
    digest = hashlib.blake2b(digest_size=8)
    used = ("schemas", package) if package in HALVES else ("schemas", *HALVES, package)
    for name in used:
        for path in sorted((root / name).rglob("*.py")):
            digest.update(path.read_bytes())
    return f"{package}-{digest.hexdigest()}"


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
            # The files in this folder are executed, so no other user may be able to write to it.
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
    with suppress(RuntimeError):  # the user has no home directory
        yield Path.home() / ".cache" / "gripmap"
    with suppress(OSError):
        yield Path(tempfile.gettempdir()) / f"gripmap-{os.getuid()}"
