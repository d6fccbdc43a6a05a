"""Skip the tests of C-ITS (interfaces for cooperative vehicles) if the extra `cits` is not
installed. It is optional, because its package python-qpid-proton needs a C compiler.
"""

from __future__ import annotations

import importlib.util

NEEDED = ("asn1tools", "proton")
missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
collect_ignore = ["test_cits.py", "test_command.py"] if missing else []
if missing:
    print(f"tests of C-ITS left out: no {', '.join(missing)}; pip install 'gripmap[cits]'")
