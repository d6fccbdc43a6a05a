"""Settings of all tests: property tests draw fixed examples, without a time limit."""

from __future__ import annotations

import pytest
from hypothesis import settings

from schemas.runtime import jit

settings.register_profile("fixed", derandomize=True, deadline=None)
settings.load_profile("fixed")


@pytest.fixture(autouse=True)
def _use_numba_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let each test begin with Numba's kernels (compiled functions). An earlier test in this
    process may have run an agent, which switches to the kernels of the shared library.
    """
    monkeypatch.setattr(jit._Native, "library", None)
