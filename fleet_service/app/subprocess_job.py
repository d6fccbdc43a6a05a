"""Work in a separate process. Its memory is freed when it ends, and it does not compete with the
service's worker thread for the interpreter lock.
"""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Sequence
from typing import Final

from schemas.errors import InputError

LOOK_S: Final = 0.1  # [s] period of the checks whether the service stops


def run_module(
    what: str, module: str, words: Sequence[str], stop: threading.Event, document: str | None = None
) -> str | None:
    """Run a Python module as a process, with the arguments `words` and the text `document` on its
    standard input. Return its stdout, or None if `stop` was set. If `stop` is set, the process is
    killed, so it must be a job that may be killed at any time. `what` names the work in error
    messages.

    Raises:
        InputError: the process failed.
    """
    command = [sys.executable, "-m", module, *words]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True) as child:
        while True:
            try:
                output, errors = child.communicate(document, LOOK_S)
                break
            except subprocess.TimeoutExpired:
                document = None  # the process has already received the text
                if stop.is_set():
                    child.terminate()
                    return None
    if child.returncode:
        raise InputError(
            what, errors.strip() or f"ended with {child.returncode}", "the service tries it again"
        )
    return output.strip()
