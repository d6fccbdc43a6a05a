"""Cost of each part on this machine; `make bench`."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the service and the agent have it: `schemas.operator.lean`
