"""Run the commands of the tutorials as written and in order, in a separate network namespace and an
empty folder.

Commands that keep running (router, service, agent, watch, page) are started and must still run at
the end. `pip install` is not run.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Final

from tests.structure import ROOT

PAGES: Final = tuple(
    ROOT / "deploy" / "docs" / name
    for name in (
        "tutorials/first-map.md",
        "tutorials/first-drive.md",
        "tutorials/first-analysis.md",
        "tutorials/reproduce-a-paper.md",
        "how-to/certificates.md",
    )
)
LASTING: Final = (
    "python -m deploy.router",
    "gripmap router",
    "edge-agent fleet",
    "fleet-service run",
    "edge-agent run",
    "fleet-service watch",
    "fleet-service page",
)
LEFT_OUT: Final = ("pip install",)
READY: Final = {"fleet-service run": "ready: "}  # what a person waits for before the next line
SETTLE_S: Final = 2.0  # until what says nothing is up
LONGEST_S: Final = 300.0


def list_blocks(text: str) -> list[tuple[str, str]]:
    """Return language and text of each fenced block of a page."""
    return [
        (m[1], m[2]) for m in re.finditer(r"^```(\w*)\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    ]


def read_pages() -> str:
    """Return the text of all pages whose commands are run."""
    return "\n".join(page.read_text(encoding="utf-8") for page in PAGES)


def list_commands(text: str) -> list[str]:
    """Return the commands of a page without their comments; a block of Python is one command."""
    found = []
    for language, block in list_blocks(text):
        if language == "python":
            found.append(block)
        else:
            lines = (re.sub(r"\s{2,}#.*", "", line).strip() for line in block.splitlines())
            found += [
                line
                for line in lines
                if line.startswith(("python ", "gripmap ", "fleet-service ", "edge-agent "))
            ]
    return [one for one in found if not one.startswith(LEFT_OUT)]


def run_all(folder: Path) -> list[str]:
    """Run all commands. Return those that failed, with the last line that they printed."""
    for name in ("deploy", "tests/data"):
        shutil.copytree(
            ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__", "*.py")
        )
    bin_folder = Path(sys.executable).parent
    staying: list[tuple[str, subprocess.Popen[bytes]]] = []
    failed: list[str] = []
    try:
        for number, command in enumerate(list_commands(read_pages())):
            log = folder / f"{number}.log"
            if command.startswith(LASTING):
                if "certs/" in command:  # the second router wants the port of the first
                    for words, process in staying:
                        _end_process(words, process, failed)
                    staying.clear()
                with log.open("wb") as out:
                    typed = command.split()
                    process = subprocess.Popen(
                        [str(bin_folder / typed[0]), *typed[1:]], cwd=folder, stdout=out, stderr=out
                    )
                staying.append((command, process))
                _await_ready(command, process, log)
                if process.poll() is not None:
                    failed.append(f"{command}: ended with {process.returncode}: {_last_line(log)}")
                    staying.pop()
                continue
            line = [sys.executable, "-c", command] if "\n" in command else ["bash", "-c", command]
            code = _run_to_end(
                line, folder, log, {"PATH": f"{bin_folder}:/usr/bin:/bin", "HOME": str(Path.home())}
            )
            if code:
                failed.append(f"{command}: {code}: {_last_line(log)}")
    finally:
        for words, process in staying:
            _end_process(words, process, failed)
    return failed


def _run_to_end(line: list[str], folder: Path, log: Path, environment: dict[str, str]) -> int | str:
    """Return the exit code of a command, or a message that it did not end in time."""
    with log.open("wb") as out:
        try:
            done = subprocess.run(
                line,
                cwd=folder,
                stdout=out,
                stderr=out,
                check=False,
                timeout=LONGEST_S,
                env=environment,
            )
        except subprocess.TimeoutExpired:  # the others are tried all the same
            return f"did not end within {LONGEST_S:g} s"
    return done.returncode


def _await_ready(command: str, process: subprocess.Popen[bytes], log: Path) -> None:
    word = next((word for start, word in READY.items() if command.startswith(start)), None)
    deadline = time.monotonic() + (SETTLE_S if word is None else LONGEST_S)
    while process.poll() is None and time.monotonic() < deadline:
        if word is not None and any(
            line.startswith(word) for line in log.read_text(errors="replace").splitlines()
        ):
            return
        time.sleep(0.1)


def _end_process(command: str, process: subprocess.Popen[bytes], failed: list[str]) -> None:
    if process.poll() is not None:
        failed.append(f"{command}: ended by itself with {process.returncode}")
        return
    process.terminate()
    try:
        process.wait(20)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        failed.append(f"{command}: had to be killed")


def _last_line(log: Path) -> str:
    lines = log.read_text(errors="replace").strip().splitlines()
    return lines[-1][:200] if lines else "no word"


def main() -> int:
    """Run all commands in a folder, and print the failed ones as JSON. The process must have its
    own network namespace.
    """
    print(json.dumps(run_all(Path(sys.argv[1]))))
    return 0


if __name__ == "__main__":
    sys.exit(main())
