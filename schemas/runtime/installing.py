"""Commands that install optional dependencies ("extras") of this distribution. They refer to the
source from which the distribution was installed, because no package index offers it.
"""

from __future__ import annotations

import json
import shlex
from importlib import metadata

NAME = "gripmap"


def install_command(extra: str) -> str:
    """Return a shell command that installs an extra (group of optional dependencies) of this
    distribution into the Python environment of this process.
    """
    try:
        text = metadata.distribution(NAME).read_text("direct_url.json")
    except metadata.PackageNotFoundError:
        text = None
    origin = json.loads(text) if text else {}
    address = str(origin.get("url", ""))
    if "dir_info" in origin:
        editable = "--editable " if origin["dir_info"].get("editable") else ""
        return (
            f"pip install {editable}{shlex.quote(address.removeprefix('file://') + f'[{extra}]')}"
        )
    if address:
        return f"pip install {shlex.quote(f'{NAME}[{extra}] @ {address}')}"
    return f"pip install {shlex.quote(f'.[{extra}]')} in a checkout, or the wheel with [{extra}]"
