"""Settings of all tests: property tests draw the same examples in every run, without a time limit."""

from __future__ import annotations

from hypothesis import settings

settings.register_profile("fixed", derandomize=True, deadline=None)
settings.load_profile("fixed")
