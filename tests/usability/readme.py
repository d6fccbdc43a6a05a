"""Run the commands of the README and of the tutorials as written and in order, in a separate
network namespace and an empty folder. Look in a browser at the maps that they make.

Commands that keep running (router, service, agent, watch, page) are started and must still run at
the end. `pip install` is not run.
"""

from __future__ import annotations

import contextlib
import json
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from tests.browser import open_page
from tests.structure import ROOT
from tests.waiting import until

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
READY: Final = {"fleet-service run": "ready: "}  # output that a user waits for
SETTLE_S: Final = 2.0  # wait for programs that print nothing when they are ready
LONGEST_S: Final = 300.0


README: Final = ROOT / "README.md"
# Command in the README; `make` only installs the package and calls `gripmap`.
DEMO: Final = "make demo ARGS=--stay"
LIVE_PAGE: Final = "http://127.0.0.1:8080/"
# Maps that a reader looks at after the last command of a page.
MAPS: Final[dict[str, dict[str, str]]] = {
    "first-map.md": {"page after the first map": LIVE_PAGE},
    "first-drive.md": {"page after the first drive": LIVE_PAGE},
    "first-analysis.md": {"page at the end": LIVE_PAGE, "map of the analysis": "try/grip.html"},
}
LEAST_CELLS: Final = 100
LEAST_PX: Final = 200  # [px] least extent of the drawn map in one direction in the first picture


def list_blocks(text: str) -> list[tuple[str, str]]:
    """Return the language and the text of each fenced code block of a Markdown page."""
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


def run_all(folder: Path) -> tuple[list[str], dict[str, str]]:
    """Run all commands of PAGES in a folder. Return the commands that failed, with the last line
    that they printed. Also return, for each map in MAPS, "" if it counts as populated (see
    `look_at_map`), otherwise the reason why not.
    """
    for name in ("deploy", "tests/data"):
        shutil.copytree(
            ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__", "*.py")
        )
    bin_folder = Path(sys.executable).parent
    staying: list[tuple[str, subprocess.Popen[bytes]]] = []
    failed: list[str] = []
    maps: dict[str, str] = {}
    try:
        for number, (command, looks) in enumerate(_list_steps()):
            log = folder / f"{number}.log"
            for name, place in looks.items():
                maps[name] = look_at_map(place if place == LIVE_PAGE else folder / place)
            if command is None:
                continue
            if command.startswith(LASTING):
                if "certs/" in command:  # the second router needs the port of the first
                    _end_processes(staying, failed)
                    staying.clear()
                process = _start_process(command, folder, log)
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
        _end_processes(staying, failed)
    return failed, maps


def _start_process(command: str, folder: Path, log: Path) -> subprocess.Popen[bytes]:
    program, *arguments = command.split()
    path = Path(sys.executable).parent / program
    with log.open("wb") as out:
        return subprocess.Popen([str(path), *arguments], cwd=folder, stdout=out, stderr=out)


def _list_steps() -> Iterator[tuple[str | None, dict[str, str]]]:
    """Yield the steps of a reader who follows PAGES. A step is a pair (command, maps); `maps`
    contains the name and the address or file of each map that the reader opens in a browser. For
    each command of a page, yield (command, {}). After its last command, yield (None, maps).
    """
    for page in PAGES:
        for command in list_commands(page.read_text(encoding="utf-8")):
            yield command, {}
        yield None, MAPS.get(page.name, {})


def look_at_map(place: str | Path) -> str:
    """Open a map in a browser. Return "" if it counts as populated, otherwise the reason why not.

    A populated map shows at least LEAST_CELLS cells, drawn over at least LEAST_PX pixels. The user
    need not click for it, no error occurs, and no card covers it.
    """
    with open_page(place) as seen:
        if isinstance(place, str):
            seen.page.wait_for_selector("body[data-ready]", state="attached")
        with contextlib.suppress(TimeoutError):
            until(lambda: seen.drawn_count >= LEAST_CELLS)
        extent = seen.page.evaluate(_EXTENT)
        if seen.drawn_count < LEAST_CELLS:
            return f"{seen.drawn_count} cells are drawn"
        if max(extent) < LEAST_PX:
            return f"all that is drawn covers {extent} px"
        if isinstance(place, str) and seen.page.locator("#card").is_visible():
            return seen.page.locator("#card").inner_text()
        return "; ".join(seen.errors)


# Width and height of the part of the map that has class colours or hatching.
_EXTENT: Final = """() => {
  const map = document.querySelector("canvas"), ratio = map.width / map.clientWidth;
  const { data } = map.getContext("2d").getImageData(0, 0, map.width, map.height);
  const ground = data.slice(0, 4).join();
  let left = map.width, right = 0, top = map.height, bottom = 0;
  for (let k = 0; k < data.length; k += 4) {
    if (data.slice(k, k + 4).join() === ground) continue;
    const x = k / 4 % map.width, y = Math.floor(k / 4 / map.width);
    left = Math.min(left, x); right = Math.max(right, x);
    top = Math.min(top, y); bottom = Math.max(bottom, y);
  }
  return [Math.max(0, right - left) / ratio, Math.max(0, bottom - top) / ratio];
}"""


def look_at_demo(folder: Path) -> str:
    """Run the README's demo, and look at the map on its page. Return "" if the map counts as
    populated (see `look_at_map`), otherwise the reason why not.
    """
    assert DEMO in README.read_text(encoding="utf-8"), "the README names the demo otherwise"
    log = folder / "demo.log"
    command = [str(Path(sys.executable).parent / "gripmap"), "demo", "--stay"]
    with log.open("wb") as out:
        demo = subprocess.Popen(command, cwd=folder, stdout=out, stderr=out)
    failed: list[str] = []
    try:
        deadline = time.monotonic() + 2 * LONGEST_S
        while "runs until Ctrl-C" not in (text := log.read_text(errors="replace")):
            if demo.poll() is not None or time.monotonic() > deadline:
                return f"the demo did not get so far: {_last_line(log)}"
            time.sleep(0.5)
        address = re.search(r"Live map: (\S+)", text)
        return look_at_map(address[1]) if address else "the demo names no address"
    finally:
        _end_process("gripmap demo", demo, failed)


def _run_to_end(line: list[str], folder: Path, log: Path, environment: dict[str, str]) -> int | str:
    """Run a command to its end. Return its exit code, or a message that it did not end in time."""
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
        except subprocess.TimeoutExpired:  # the remaining commands are tried all the same
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


def _end_processes(staying: list[tuple[str, subprocess.Popen[bytes]]], failed: list[str]) -> None:
    for command, process in staying:
        _end_process(command, process, failed)


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
    """Run the demo of the README and the commands of PAGES in the folder that the command line
    names. Print as JSON the commands that failed, and for each map that the commands have made, ""
    or the reason why it does not count as populated. The process must have its own network
    namespace.
    """
    folder = Path(sys.argv[1])
    demo = look_at_demo(folder)
    failed, maps = run_all(folder)
    print(json.dumps({"failed": failed, "maps": {"page of the demo": demo} | maps}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
