"""Tests that compiled functions are compiled again when their sources change."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

CALLER = """from {package}.inner import inner
from schemas.runtime.jit import compiled

@compiled
def outer(x: float) -> float:
    return inner(x) + 1.0
"""
INNER = """from schemas.runtime.jit import compiled

@compiled
def inner(x: float) -> float:
    return {factor} * x
"""


FULL_DISK = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0)); "


def run_outer(folder: Path, factor: str, before: str = "", package: str = "kernels") -> str:
    """Write two compiled functions: `inner` in `package` multiplies by `factor`, and `outer` in the
    package "kernels" calls `inner`. Return the result of outer(1.0) in a new process.
    """
    for name in ("kernels", package):
        (folder / name).mkdir(exist_ok=True)
        (folder / name / "__init__.py").touch()
    (folder / "kernels" / "outer.py").write_text(CALLER.format(package=package))
    (folder / package / "inner.py").write_text(INNER.format(factor=factor))
    source = Path(__file__).parents[3] / "schemas"
    if not (folder / "schemas").exists():
        (folder / "schemas").symlink_to(source, target_is_directory=True)
    environment = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"}
    environment |= {"XDG_CACHE_HOME": str(folder / "cache"), "PYTHONPATH": str(folder)}
    # Python's own cache cannot distinguish two sources of the same length that were written in the
    # same second.
    environment |= {"PYTHONDONTWRITEBYTECODE": "1"}
    words = [sys.executable, "-c", f"{before}from kernels.outer import outer; print(outer(1.0))"]
    return subprocess.run(
        words, env=environment, cwd=folder, capture_output=True, text=True, check=True
    ).stdout.strip()


@pytest.mark.campaign
@pytest.mark.parametrize("package", ["kernels", "edge_agent"])
def test_changed_kernel_invalidates_the_caches_of_its_callers(tmp_path: Path, package: str) -> None:
    assert run_outer(tmp_path, "2.0", package=package) == "3.0"
    assert run_outer(tmp_path, "5.0", package=package) == "6.0"
    assert len(list((tmp_path / "cache" / "gripmap").glob("kernels-*"))) == 2


def test_a_full_disk_under_the_cache_costs_only_the_cache(tmp_path: Path) -> None:
    assert run_outer(tmp_path, "2.0", FULL_DISK) == "3.0"
    assert not list((tmp_path / "cache").rglob("*.nbc"))


@pytest.mark.campaign
@pytest.mark.parametrize("place", ["/proc/nowhere", ""])
def test_without_a_writable_cache_kernels_compile_at_each_start(tmp_path: Path, place: str) -> None:
    """A service account without a home folder, or a read-only container, has no writable cache
    folder. Kernels (compiled functions) must then be compiled at each start, without a traceback
    and without files elsewhere.
    """
    homeless = (
        "import os, tempfile; from pathlib import Path; tempfile.tempdir = '/proc/nowhere'; "
        f"os.environ.update(HOME='/proc/nowhere', XDG_CACHE_HOME={place!r}); "
    )
    assert run_outer(tmp_path, "2.0", homeless) == "3.0"
    assert not (tmp_path / "cache").exists()
    assert (
        run_outer(
            tmp_path, "2.0", homeless.replace("'/proc/nowhere'; from", f"{str(tmp_path)!r}; from")
        )
        == "3.0"
    )


@pytest.mark.campaign
def test_a_cache_that_others_may_write_is_not_used(tmp_path: Path) -> None:
    shared = tmp_path / "cache" / "gripmap"
    shared.mkdir(parents=True)
    shared.chmod(0o777)
    assert (
        run_outer(tmp_path, "2.0", f"import os; os.environ['HOME'] = {str(tmp_path / 'home')!r}; ")
        == "3.0"
    )
    assert not list(shared.iterdir())
    assert list((tmp_path / "home" / ".cache" / "gripmap").iterdir())
