"""Benchmarks of the cost of each part on this machine; run by `make bench`."""

import os

# The service and the agent set the same limit, see `schemas.runtime.process.limit_memory`.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
