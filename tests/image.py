"""`make image`: runs the steps of deploy/Dockerfile as a script, without a container engine.

Folders of the image become folders below another root. Calls of apt-get do nothing: the tools are
those of this machine. The Python version that FROM names is taken from this machine, in a fresh
environment. The USER instruction is checked, but the user is not changed. Then a router and a
service of the image are started; the service must be ready without compiling anything.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Final

from schemas.runtime.progress_messages import COMPILING
from tests.packaging import list_candidates
from tests.structure import ROOT
from tests.waiting import until

DOCKERFILE: Final = ROOT / "deploy" / "Dockerfile"
PLACES: Final = ("/src", "/etc/gripmap", "/var/lib/gripmap", "/var/cache/gripmap", "/var/lib/apt")
OURS: Final = (
    "PIP_",
    "SSL_",
    "REQUESTS_",
    "CURL_",
    "HTTP",
    "HTTPS",
    "NO_PROXY",
    "http_",
    "https_",
    "no_proxy",
)
START_S: Final = 60.0


def parse_steps(text: str) -> list[tuple[str, str]]:
    """Return (instruction, arguments) for each step of a Dockerfile."""
    lines = [line for line in text.splitlines() if not line.lstrip().startswith("#")]
    joined = re.sub(r"\\\n", " ", "\n".join(lines))
    parted = [line.partition(" ") for line in joined.splitlines() if line.strip()]
    return [(name, rest.strip()) for name, _, rest in parted]


class Image:
    """Container image after the steps that were run: its folders (below `root`), working folder and
    environment.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self.user = "root"
        self.folder = root
        kept = {name: value for name, value in os.environ.items() if name.startswith(OURS)}
        self.environment = {**kept, "HOME": str(root / "home"), "LANG": "C.UTF-8"}

    def localize_paths(self, text: str) -> str:
        """Return the text of an instruction for this machine. Folders of the image become folders
        below `root`, and the owner in `chown` becomes this user.
        """
        for place in PLACES:
            text = re.sub(rf"(?<![\w.]){re.escape(place)}\b", str(self.root) + place, text)
        return re.sub(r"chown (-R )?\d+:\d+", rf"chown \g<1>{os.getuid()}:{os.getgid()}", text)

    def run_step(self, name: str, words: str) -> None:
        """Run one instruction of the Dockerfile."""
        if name == "FROM":
            self._start_from(words)
        elif name == "WORKDIR":
            self.folder = Path(self.localize_paths(words))
            self.folder.mkdir(parents=True, exist_ok=True)
        elif name == "COPY":
            *sources, to = words.split()
            for source in sources:
                self._copy_path(ROOT / source, self.folder / to)
        elif name == "ENV":
            key, _, value = words.partition("=")
            self.environment[key] = self.localize_paths(value)
        elif name == "USER":
            self.user = words
        elif name == "RUN":
            self.run_command("bash", "-euc", self.localize_paths(words))
        else:
            raise SystemExit(f"error: {name}: is no step that is known here")

    def run_command(self, *words: str) -> None:
        """Run a command with the folders of the image. Raise CalledProcessError if its exit code is
        not 0.
        """
        subprocess.run(words, cwd=self.folder, env=self.environment, check=True)

    def _start_from(self, base: str) -> None:
        version = re.fullmatch(r"python:(\d+\.\d+)-slim", base)
        assert version, base
        asked = "import sys; print('%d.%d' % sys.version_info[:2])"
        for command in list_candidates(version[1]):
            done = subprocess.run(
                [command, "-c", asked], capture_output=True, text=True, check=False
            )
            if done.stdout.strip() == version[1]:
                subprocess.run([command, "-m", "venv", self.root / "usr"], check=True)
                (self.root / "usr" / "bin" / "apt-get").symlink_to("/bin/true")
                self.environment["PATH"] = f"{self.root / 'usr' / 'bin'}:/usr/bin:/bin"
                return
        raise SystemExit(f"error: Python {version[1]}: is not on this machine")

    @staticmethod
    def _copy_path(source: Path, to: Path) -> None:
        if source.is_dir():
            shutil.copytree(source, to, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(source, to / source.name if to.is_dir() else to)


def time_start(image: Image) -> float:
    """Start a service of the container image, and return the time [s] until it is ready. It must
    not compile anything.
    """
    port = "127.0.0.1:0"
    with subprocess.Popen(
        ["python", "-m", "deploy.router", "--listen", f"tcp/{port}"],
        cwd=image.folder,
        env=image.environment,
        stdout=subprocess.PIPE,
        text=True,
    ) as router:
        assert router.stdout is not None
        endpoint = router.stdout.readline().split()[1]
        config = image.folder / "service.json"
        lines = image.folder / "lines"
        config.write_text(f'{{"zenoh": {{"connect": ["{endpoint}"]}}}}')
        began = time.monotonic()
        with lines.open("w") as out:
            words = [
                "fleet-service",
                "run",
                "--config",
                str(config),
                "--archive",
                str(image.folder / "archive"),
            ]
            service = subprocess.Popen(
                words, cwd=image.folder, env=image.environment, stdout=out, stderr=out
            )
        until(lambda: service.poll() is not None or "ready: " in lines.read_text(), START_S)
        elapsed_s = time.monotonic() - began
        for process in (service, router):
            process.send_signal(signal.SIGTERM)
            assert process.wait(30) == 0, lines.read_text()
    assert "ready: " in lines.read_text()
    assert COMPILING not in lines.read_text(), "its kernels were compiled when it was built"
    return elapsed_s


def main() -> int:
    """Build the container image, start its processes, and return the exit code."""
    with tempfile.TemporaryDirectory() as folder:
        image = Image(Path(folder))
        (image.root / "home").mkdir()
        for name, words in parse_steps(DOCKERFILE.read_text()):
            began = time.monotonic()
            image.run_step(name, words)
            print(
                f"{time.monotonic() - began:6.1f} s  {name} {shlex.quote(words)[:100]}", flush=True
            )
        user, _, group = image.user.partition(":")
        assert user.isdecimal(), "Kubernetes must see that it is not root"
        assert int(user) > 0 < int(group)
        print(
            f"a service of the image is ready after {time_start(image):.1f} s, with kernels that "
            "the build has compiled"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
