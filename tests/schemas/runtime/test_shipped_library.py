"""Tests of the shared libraries of compiled kernels in the installed package. An agent may use a
library only if it was compiled from the present sources and for the agent's processor.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from schemas.runtime import jit, kernel_library, progress_messages
from schemas.runtime.jit import describe_sources
from schemas.runtime.kernel_library import KernelLibrary
from schemas.runtime.shipped_library import FEATURES, find_shipped_library

LEVEL_4 = frozenset(FEATURES["x86-64-v4"].split())
LEVEL_3 = frozenset(FEATURES["x86-64-v3"].split())


def write_libraries(folder: Path, sources: str) -> None:
    for level in FEATURES:
        (folder / f"{sources}-{level}.so").write_bytes(b"no library")


@pytest.mark.parametrize(
    ("features", "level"),
    [(LEVEL_4, "x86-64-v4"), (LEVEL_3, "x86-64-v3"), (LEVEL_4 - {"avx512bw"}, "x86-64-v3")],
)
def test_the_fastest_library_that_fits_the_processor_is_found(
    features: frozenset[str], level: str, tmp_path: Path
) -> None:
    write_libraries(tmp_path, describe_sources("edge_agent"))
    found = find_shipped_library("edge_agent", tmp_path, features)
    assert found is not None
    assert found.name.endswith(f"-{level}.so")


@pytest.mark.parametrize(
    ("sources", "features", "reason"),
    [
        ("edge_agent-0123456789abcdef", LEVEL_4, "they are for other sources"),
        (describe_sources("edge_agent"), LEVEL_3 - {"fma"}, "this processor lacks instructions"),
    ],
)
def test_a_library_for_others_is_refused_with_the_reason(
    sources: str,
    features: frozenset[str],
    reason: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """An agent whose package contains only libraries for other sources or processors must print the
    reason, and compile its kernels with Numba.
    """
    write_libraries(tmp_path, sources)
    monkeypatch.setattr(kernel_library, "read_processor_features", lambda: set(features))
    monkeypatch.setattr(kernel_library, "native_library_path", lambda _: None)
    progress_messages.enable_messages()
    try:
        assert not KernelLibrary("edge_agent", "no.module", tmp_path).use()
    finally:
        progress_messages.enable_messages(quiet=True)
    assert capsys.readouterr().err == f"kernels in {tmp_path}: not used, because {reason}\n"
    assert jit._Native.library is None


def test_a_package_without_libraries_reports_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert find_shipped_library("edge_agent", tmp_path / "none", LEVEL_4) is None
    assert capsys.readouterr().err == ""
