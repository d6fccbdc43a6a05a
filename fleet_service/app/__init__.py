"""The running service: engine (service without its network), Zenoh sessions, background jobs,
metrics.
"""

from typing import Final

# 25 MB that a running service's libraries load where they find them: for matrix products in
# kernels, of which there are none, and for file systems that only a compaction writes to, which is
# a process of its own.
UNUSED: Final = ("scipy", "pyarrow._s3fs", "pyarrow._gcsfs", "pyarrow._azurefs", "pyarrow._hdfs")
