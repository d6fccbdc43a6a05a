"""Build of the shared library of native kernels (see `native_kernels`) with Numba, LLVM and the
system's linker.

A *kernel* is a compiled numerical function. First, a program runs with a `CallRecorder` instead of
a library; it records which kernels are called, and with which types of arguments. Then each
recorded kernel becomes a C function of the library, with the machine code that Numba itself would
run.
"""

# Numba and LLVM provide no types.
# ruff: noqa: ANN401

from __future__ import annotations

import os
import pickle
import re
import subprocess
import tempfile
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any, Final, NamedTuple

import llvmlite.binding as llvm  # type: ignore[import-untyped]
import numba
import numpy as np
from llvmlite import ir
from numba.core import codegen, cpu, types
from numba.extending import intrinsic

from schemas.runtime.native_kernels import (
    DATA_OFFSET,
    DONE,
    DONE_FLOAT,
    HEADER,
    LINKER,
    Library,
    NativeKernel,
    describe_type,
    symbol_of,
)

LINKED: Final = ("-shared", "-nostartfiles", "-Wl,-z,noexecstack")
ADAPTER: Final = "call_kernel"
# Prefixes of functions of the Numba and Python runtimes. A kernel calls them only when it fails.
RUNTIME: Final = (
    "NRT_",
    "numba_",
    "Py",
)
ALLOCATION: Final = "NRT_MemInfo_alloc"  # first part of the names of functions that allocate
RESULTS: Final = (types.none, types.int64, types.float64)


class CallRecorder(Library):
    """Stand-in for a library that has no kernels: it records each call of a kernel.

    Args:
        runs: True to run each kernel with Numba as well, for a program that needs the results.
            Otherwise each call returns 0.
    """

    def __init__(self, *, runs: bool = False) -> None:
        super().__init__(None)
        self.calls: dict[str, tuple[NativeKernel, tuple[Any, ...]]] = {}
        self._runs = runs

    def call_missing(self, kernel: NativeKernel, arguments: tuple[Any, ...]) -> Any:
        """Record a call of a kernel. Run the kernel if the recorder does so, and return its
        result.
        """
        symbol = symbol_of(kernel.name, describe_type(arguments, []))
        self.calls.setdefault(symbol, (kernel, arguments))
        return kernel.numba_kernel(*arguments) if self._runs else 0

    def save_calls(self, path: Path) -> None:
        """Write the recorded calls to the file `path`. Arrays are replaced by their types, because
        only these matter for a library.
        """
        calls = [
            (*kernel.name.rsplit(".", 1), _replace_arrays(arguments))
            for kernel, arguments in self.calls.values()
        ]
        path.write_bytes(pickle.dumps(calls))

    def load_calls(self, path: Path) -> None:
        """Record the calls that `save_calls` of another process wrote to the file `path`."""
        for module, name, types_of_arrays in pickle.loads(path.read_bytes()):
            kernel = getattr(import_module(module), name)
            arguments = _make_arrays(types_of_arrays)
            symbol = symbol_of(kernel.name, describe_type(arguments, []))
            self.calls.setdefault(symbol, (kernel, arguments))


class _ArrayType(NamedTuple):
    """Type of an array: type of its elements, number of dimensions, and whether it may be
    written.
    """

    element: np.dtype[Any]
    dimensions: int
    writeable: bool


def _replace_arrays(value: Any) -> Any:
    """Return an argument of a kernel with each array replaced by its `_ArrayType`."""
    if isinstance(value, np.ndarray):
        return _ArrayType(value.dtype, value.ndim, value.flags.writeable)
    return _rebuild_tuple(value, _replace_arrays) if isinstance(value, tuple) else value


def _make_arrays(value: Any) -> Any:
    """Return an argument of a kernel with an empty array for each `_ArrayType`."""
    if isinstance(value, _ArrayType):
        array = np.empty((0,) * value.dimensions, value.element)
        array.flags.writeable = value.writeable
        return array
    return _rebuild_tuple(value, _make_arrays) if isinstance(value, tuple) else value


def _rebuild_tuple(value: tuple[Any, ...], change: Callable[[Any], Any]) -> tuple[Any, ...]:
    parts = [change(part) for part in value]
    return tuple(parts) if type(value) is tuple else type(value)(*parts)


def build_library(recorder: CallRecorder, path: Path) -> None:
    """Compile and link the kernels (numerical functions) that `recorder` has recorded, and write
    the shared library `path`. Only a process that ends afterwards may call this function, because
    Numba cannot compile in that process any more.

    Raises:
        OSError, subprocess.CalledProcessError: there is no linker, or the linker fails.
        TypeError: a kernel allocates memory, which needs Numba's runtime.
    """
    calls: list[tuple[str, Any, tuple[Any, ...], Any]] = []
    for symbol, (native, arguments) in recorder.calls.items():
        overload = _compile_kernel(native.numba_kernel, arguments)
        if overload.signature.return_type in RESULTS:
            calls.append((symbol, native.numba_kernel, arguments, overload))
    _stop_before_machine_code()
    whole = llvm.parse_assembly("")
    for symbol, kernel, arguments, overload in calls:
        result = overload.signature.return_type
        adapter = _compile_adapter(kernel, arguments, symbol, result)
        _merge_modules(whole, overload, adapter, symbol)
    path.parent.mkdir(parents=True, exist_ok=True)
    code = _emit_object(whole, [symbol for symbol, *_ in calls], calls[0][-1].library.codegen)
    _link_object(code, path)


def _compile_kernel(kernel: Any, arguments: tuple[Any, ...]) -> Any:
    """Compile a kernel for arguments with the same types as `arguments`. Return Numba's compilation
    result, which contains the LLVM code.
    """
    typeof: Any = numba.typeof
    kinds = tuple(typeof(argument) for argument in arguments)
    kernel.compile(kinds)
    return kernel.overloads[kinds]


def _stop_before_machine_code() -> None:
    """Make Numba, for the rest of this process, stop each compilation after it has generated the
    LLVM code. Numba then neither optimises nor links this code, and makes no machine code.

    The kernels are compiled completely before this call. Their adapters (functions that call the
    kernels, see `_Adapter`) are compiled afterwards. Otherwise Numba would optimise a kernel's code
    again as part of its adapter. A second optimisation may choose other pairs of multiplication and
    addition to fuse, which changes the last bit of results.
    """
    library: Any = codegen.JITCodeLibrary
    library.finalize = _mark_finalized
    library.get_pointer_to_function = lambda *_: 0
    target: Any = cpu.CPUContext
    target.create_cpython_wrapper = lambda *_, **__: None
    target.get_executable = lambda *_: [].append  # Numba needs a new built-in function here


def _mark_finalized(library: Any) -> None:
    library._finalized = True


def _pointer_of(context: Any, word: Any, element: Any) -> Any:  # noqa: ARG001
    pointer = types.CPointer(element.instance_type)  # type: ignore[no-untyped-call]

    def generate(target: Any, builder: Any, signature: Any, values: Any) -> Any:  # noqa: ARG001
        return builder.inttoptr(values[0], target.get_value_type(pointer))

    return pointer(types.int64, element), generate


def _data_of(context: Any, array: Any) -> Any:  # noqa: ARG001
    word = ir.IntType(64)

    def generate(target: Any, builder: Any, signature: Any, values: Any) -> Any:  # noqa: ARG001
        place = builder.add(values[0], word(DATA_OFFSET))
        return builder.load(builder.inttoptr(place, word.as_pointer()))

    return types.int64(types.int64), generate


def _read_only_of(context: Any, array: Any) -> Any:  # noqa: ARG001
    kind = array.copy(readonly=True)

    def generate(target: Any, builder: Any, signature: Any, values: Any) -> Any:  # noqa: ARG001
        return values[0]  # both types have the same representation in memory

    return kind(array), generate


def _float_of(context: Any, word: Any) -> Any:  # noqa: ARG001
    def generate(target: Any, builder: Any, signature: Any, values: Any) -> Any:  # noqa: ARG001
        return builder.bitcast(values[0], target.get_value_type(types.float64))

    return types.float64(types.int64), generate


def _bits_of(context: Any, number: Any) -> Any:  # noqa: ARG001
    def generate(target: Any, builder: Any, signature: Any, values: Any) -> Any:  # noqa: ARG001
        return builder.bitcast(values[0], target.get_value_type(types.int64))

    return types.int64(types.float64), generate


class _Adapter:
    """Source text of a function ("adapter") that calls a kernel (compiled numerical function). The
    adapter's only argument is an array of 64-bit words (see `native_kernels`), from which it builds
    the kernel's arguments.
    """

    def __init__(self, kernel: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
        self._words = HEADER
        self._namespace: dict[str, Any] = {
            "kernel": kernel,
            "carray": numba.carray,  # type: ignore[attr-defined]
            "pointer_of": intrinsic(_pointer_of),
            "float_of": intrinsic(_float_of),
            "bits_of": intrinsic(_bits_of),
            "read_only_of": intrinsic(_read_only_of),
            "data_of": intrinsic(_data_of),
        }
        self._call = f"kernel({', '.join(self._expression(one) for one in arguments)})"

    def make_function(self, result: Any) -> Callable[..., Any]:
        """Return the adapter as a Python function with one argument, the array of 64-bit words. The
        function calls the kernel, stores the kernel's result (if any, of the type `result`) in word
        1, and sets word 0 to DONE or DONE_FLOAT.
        """
        call = {
            types.none: self._call,
            types.int64: f"words[1] = {self._call}",
            types.float64: f"words[1] = bits_of({self._call})",
        }[result]
        mark = DONE_FLOAT if result == types.float64 else DONE
        text = f"def {ADAPTER}(words):\n    {call}\n    words[0] = {mark}\n"
        exec(text, self._namespace)
        return self._namespace[ADAPTER]  # type: ignore[no-any-return]

    def _next_word(self) -> str:
        self._words += 1
        return f"words[{self._words - 1}]"

    def _name_of(self, value: Any) -> str:
        name = f"known_{len(self._namespace)}"
        self._namespace[name] = value
        return name

    def _expression(self, value: Any) -> str:
        """Return the source text of an expression that builds one argument of the kernel, of the
        type of `value`. The expression reads the argument from the next words of the adapter's
        array that no earlier argument uses. `describe_type` determines the order of the words.
        """
        if isinstance(value, np.ndarray):
            element = self._name_of(numba.from_dtype(value.dtype))
            address = f"pointer_of(data_of({self._next_word()}), {element})"
            shape = "".join(f"{self._next_word()}, " for _ in range(value.ndim))
            array = f"carray({address}, ({shape}))"
            return array if value.flags.writeable else f"read_only_of({array})"
        if isinstance(value, tuple):
            parts = "".join(f"{self._expression(part)}, " for part in value)
            make = "" if type(value) is tuple else self._name_of(type(value))
            return f"{make}({parts})"
        word = self._next_word()
        if isinstance(value, bool):
            return f"{word} != 0"
        return f"float_of({word})" if isinstance(value, float) else word


def _compile_adapter(kernel: Any, arguments: tuple[Any, ...], symbol: str, result: Any) -> Any:
    """Compile the adapter of a kernel (see `_Adapter`) as a C function with the name `symbol`;
    return the Numba code library that contains it. `result` is the type of the kernel's result.
    """
    function = _Adapter(kernel, arguments).make_function(result)
    words = types.CPointer(types.int64)  # type: ignore[no-untyped-call]
    adapter: Any = numba.cfunc(types.void(words), error_model="numpy")(function)
    adapter._library._final_module.get_function(adapter.native_name).name = symbol
    return adapter._library


def _merge_modules(whole: Any, overload: Any, adapter: Any, symbol: str) -> None:
    """Add the LLVM code of a kernel, of its adapter (see `_Adapter`) and of the functions that the
    adapter calls to the LLVM module `whole`. The code of a kernel already contains all functions
    that it calls.

    Raises:
        TypeError: the kernel allocates memory.
    """
    visible = {symbol, overload.fndesc.llvm_func_name}
    code = overload.library._get_module_for_linking().clone()
    if any(function.name.startswith(ALLOCATION) for function in code.functions):
        name = overload.fndesc.qualname
        raise TypeError(f"{name} allocates memory: pass the array as an argument")
    _hide_functions(code, visible, "internal")
    whole.link_in(code)
    seen = {overload.library}
    found = [adapter]
    while found:
        library = found.pop()
        if library not in seen:
            seen.add(library)
            found.extend(library._linking_libraries)
            code = library._final_module.clone()
            _hide_functions(code, visible, "weak_odr")
            whole.link_in(code)


def _hide_functions(module: Any, visible: set[str], linkage: str) -> None:
    for function in module.functions:
        if not function.is_declaration:
            function.linkage = "external" if function.name in visible else linkage


def _emit_object(whole: Any, symbols: list[str], numba_codegen: Any) -> bytes:
    """Return the object code (machine code before linking) of the LLVM module `whole`. Only the
    functions named in `symbols` are visible to other programs. The code is made for the same
    processor and with the same options as Numba's own machine code.
    """
    for function in [one for one in whole.functions if one.is_declaration]:
        if function.name.startswith(RUNTIME):
            whole.link_in(llvm.parse_assembly(_empty_definition(str(function))))
    for one in (*whole.functions, *whole.global_variables):
        if not one.is_declaration:
            one.linkage = "external" if one.name in symbols else "internal"
    options: dict[str, Any] = {}
    numba_codegen._customize_tm_options(options)
    machine = llvm.Target.from_triple(llvm.get_process_triple()).create_target_machine(
        cpu=options["cpu"], features=options["features"], opt=3, reloc="pic"
    )
    code: bytes = machine.emit_object(whole)
    return code


def _empty_definition(declaration: str) -> str:
    """Return the LLVM text of a function that does nothing and returns zero. `declaration` is the
    function's LLVM declaration.
    """
    line = next(one for one in declaration.splitlines() if one.startswith("declare"))
    line = re.sub(r"\s#\d+$", "", line.rstrip())
    result = line.split()[1]
    value = "ret void" if result == "void" else f"ret {result} zeroinitializer"
    return f"{line.replace('declare', 'define', 1)} {{\n  {value}\n}}\n"


def _link_object(code: bytes, path: Path) -> None:
    """Link the object code `code` to a shared library. The file `path` appears only when the
    library is complete.
    """
    draft = path.with_suffix(f".{os.getpid()}")
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "kernels.o"
        source.write_bytes(code)
        try:
            words = [LINKER, *LINKED, "-o", str(draft), str(source), "-lm"]
            subprocess.run(words, check=True, capture_output=True)
            draft.replace(path)
        finally:
            with suppress(OSError):
                draft.unlink()
