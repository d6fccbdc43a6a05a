"""Settings of all tests: property tests draw the same examples in every run, and an example may take
any time.
"""

from __future__ import annotations

from hypothesis import settings

settings.register_profile("fixed", derandomize=True, deadline=None)
settings.load_profile("fixed")
