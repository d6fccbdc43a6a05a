"""The running service: engine (the parts of the service without its network), Zenoh sessions,
background jobs, metrics.
"""

from typing import Final

# Modules that libraries load if they are installed, and that a running service never uses (25 MB).
# SciPy would serve matrix products in compiled functions, which have none. The cloud file systems
# of Arrow serve only compaction, which runs as a separate process.
UNUSED: Final = ("scipy", "pyarrow._s3fs", "pyarrow._gcsfs", "pyarrow._azurefs", "pyarrow._hdfs")
