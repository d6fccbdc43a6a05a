"""Benchmarks of the cost of each part on this machine; run by `make bench`."""

import os

os.environ.setdefault(
    "OPENBLAS_NUM_THREADS", "1"
)  # as service and agent have it: `schemas.runtime.process.limit_memory`
