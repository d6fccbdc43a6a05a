"""Settings of all tests: property tests draw fixed examples, without a time limit."""

from __future__ import annotations

from hypothesis import settings

settings.register_profile("fixed", derandomize=True, deadline=None)
settings.load_profile("fixed")
