"""Shared library with the kernels (compiled functions) of a program. The program then needs neither
Numba nor LLVM, whose import takes 60 MB and half a second.

The installed package may contain such libraries. Otherwise a separate process builds one, once per
version of the sources and kind of processor, so that the program never has the compiler in its
memory.
"""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np

from schemas.runtime import progress_messages
from schemas.runtime.jit import native_library_path, use_native_kernels
from schemas.runtime.native_kernels import DATA_OFFSET, LINKER, Library
from schemas.runtime.shipped_library import (
    build_shipped_libraries,
    find_shipped_library,
    read_processor_features,
)


class KernelLibrary(NamedTuple):
    """Place of the shared library of a program, and the module that builds it.

    Attributes:
        package: the Python package that contains the kernels.
        builder: module that builds the library: `python -m builder FILE`.
        shipped: folder of the libraries that the installed package contains.
    """

    package: str
    builder: str
    shipped: Path

    def use(self) -> bool:
        """Take the kernels of this process from a shared library: one of the package if it suits
        this machine, else one that was built on this machine, now or at an earlier start.

        Return True if a library is used. Return False if there is no linker or no folder for the
        library, or if the build fails; Numba then compiles the kernels.
        """
        shipped = find_shipped_library(self.package, self.shipped, read_processor_features())
        if shipped is not None and _load_library(shipped):
            return True
        path = native_library_path(self.package)
        if path is None or not (path.exists() or shutil.which(LINKER)):
            return False
        if not path.exists():
            progress_messages.report_once(progress_messages.COMPILING)
            progress_messages.set_status("compiling kernels")
            build = [sys.executable, "-m", self.builder, str(path)]
            if subprocess.run(build, capture_output=True, check=False).returncode:
                return False
        return _load_library(path)

    def build_shipped(self, *words: str) -> None:
        """Build the libraries that the installed package contains, see `shipped_library`. The
        builder gets the arguments `words` after the name of the file.
        """
        build_shipped_libraries(self.package, self.shipped, self.builder, *words)


def _load_library(path: Path) -> bool:
    """Take the kernels of this process from the library at `path`, and return True. If the
    operating system refuses to load the library, report the reason and return False. Also return
    False if this Python has another layout of array objects than a library needs.
    """
    array = np.zeros(1)
    if ctypes.c_void_p.from_address(id(array) + DATA_OFFSET).value != array.ctypes.data:
        return False
    try:
        use_native_kernels(Library(path))
    except OSError as error:
        progress_messages.report(f"kernels in {path}: not used, because of an error: {error}")
        return False
    return True
