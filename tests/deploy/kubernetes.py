"""Check of the manifests in deploy/kubernetes: they are built by kustomize and validated against
Kubernetes' schemas, and the commands of their pods are started.

    python -m tests.deploy.kubernetes        writes .kube/figures.json: kube.invalid,
                                             kube.commands_failed

A pod is simulated on this machine by processes, one per container, with the command and the
environment of the manifest. The container's mounts are folders in the pod's temporary folder, and
pod names and ports are replaced by addresses of this machine. Nothing is applied to a cluster.
Objects that need a real cluster (kinds of volumes, policies, load balancers) are validated but not
simulated.
"""

from __future__ import annotations

import http.client
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final

from ruamel.yaml import YAML

from fleet_service.cli import main as fleet_service
from schemas.runtime.figures import Figure, format_table, write_figures
from schemas.runtime.jit import cache_root
from tests.buckets import BucketServer, bucket_server
from tests.ports import free_ports
from tests.structure import ROOT
from tests.waiting import until

FOLDER: Final = ROOT / "deploy" / "kubernetes"
OVERLAYS: Final = ("one-node", "secure", "three-regions")
VERSION: Final = "1.32"  # Kubernetes version of the schemas
BUCKET: Final = "gripmap-archive"
START_S: Final = 300.0  # time for a start on a busy machine, which may have to compile kernels
Manifest = dict[str, Any]


def build_overlay(overlay: str) -> list[Manifest]:
    """Return the Kubernetes objects of an overlay (variant of the manifests) that `kubectl apply
    -k` would send to a cluster.
    """
    words = ["kubectl", "kustomize", str(FOLDER / overlay)]
    done = subprocess.run(words, check=True, capture_output=True, text=True)
    return [dict(one) for one in YAML(typ="safe").load_all(done.stdout) if one]


def find_schema_errors(objects: list[Manifest]) -> list[str]:
    """Return the errors that a strict check of `objects` against Kubernetes' schemas finds. The
    check also reports unknown fields.
    """
    import kubernetes_validate

    found = []
    for one in objects:
        try:
            kubernetes_validate.validate(one, VERSION, strict=True)
        except kubernetes_validate.ValidationError as error:
            found.append(f"{one['kind']} {one['metadata']['name']}: {error.message}")
    return found


def of_kind(objects: list[Manifest], kind: str) -> list[Manifest]:
    """Return those of the Kubernetes `objects` whose kind is `kind`, such as "Service"."""
    return [one for one in objects if one["kind"] == kind]


@dataclass
class Pod:
    """Pod of a StatefulSet, simulated on this machine; its mounts lie below `root`."""

    name: str
    template: Manifest
    claims: list[str]
    root: Path
    # Port on this machine for each port of the containers.
    ports: dict[int, int] = field(default_factory=dict)

    @property
    def containers(self) -> list[Manifest]:
        """Return the containers of the pod that keep running, without the init containers."""
        return list(self.template["spec"]["containers"])

    @property
    def component(self) -> str:
        """Return the component that the pod runs: router, service or page."""
        return str(self.template["metadata"]["labels"]["app.kubernetes.io/component"])

    @property
    def grace_s(self) -> float:
        """Return the termination grace period of the pod [s]."""
        return float(self.template["spec"]["terminationGracePeriodSeconds"])

    def port_of(self, container: Manifest, named: str | int) -> int:
        """Return the port of this machine that stands for a port of the container. The container's
        port is given by its name or its number.
        """
        numbers = {one["name"]: one["containerPort"] for one in container.get("ports", [])}
        return self.ports[numbers.get(named, named)]


def make_pods(objects: list[Manifest], root: Path) -> list[Pod]:
    """Return every simulated pod of every StatefulSet in `objects`. Each container port is replaced
    by a free port of this machine.
    """
    found = []
    for one in of_kind(objects, "StatefulSet"):
        claims = [
            claim["metadata"]["name"] for claim in one["spec"].get("volumeClaimTemplates", [])
        ]
        for k in range(one["spec"]["replicas"]):
            name = f"{one['metadata']['name']}-{k}"
            pod = Pod(name, one["spec"]["template"], claims, root / name)
            numbers = [
                port["containerPort"] for part in pod.containers for port in part.get("ports", [])
            ]
            pod.ports = dict(zip(numbers, free_ports(len(numbers)), strict=True))
            found.append(pod)
    return found


class Cluster:
    """Pods of a Kubernetes overlay (variant of the manifests), simulated by processes on this
    machine.
    """

    def __init__(self, overlay: str, root: Path) -> None:
        self.overlay = overlay
        self.root = root
        self.objects = build_overlay(overlay)
        self.pods = make_pods(self.objects, root)
        self.failed: list[str] = []
        self._configs = {
            one["metadata"]["name"]: dict(one["data"]) for one in of_kind(self.objects, "ConfigMap")
        }
        self._environment = {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
        self.certificates = root / "certs"
        for data in self._configs.values():
            for name, text in data.items():
                data[name] = self._localize_addresses(name, text)
        fleet = next(
            (data["fleet.json"] for data in self._configs.values() if "fleet.json" in data), None
        )
        if fleet is not None:
            (root / "fleet.json").write_text(fleet)
            words = [
                "--fleet",
                str(root / "fleet.json"),
                "--out",
                str(self.certificates),
                "--at",
                "/etc/gripmap/certs",
            ]
            assert fleet_service(["certs", *words]) == 0

    def _localize_addresses(self, name: str, text: str) -> str:
        """Return the text of a pod's configuration file, in which each pod's address is replaced by
        an address of this machine.
        """
        for pod in self.pods:
            for number, port in pod.ports.items():
                text = text.replace(f"{pod.name}.routers:{number}", f"127.0.0.1:{port}")
        if name == "fleet.json":
            fleet = json.loads(text)
            for router, settings in fleet["routers"].items():
                (pod,) = (one for one in self.pods if one.name == router)
                settings |= {
                    "hosts": ["127.0.0.1"],
                    "listen": "127.0.0.1",
                    "port": pod.ports[settings["port"]],
                }
            return json.dumps(fleet)
        for pod in self.pods:
            own = "router.json5" if pod.component == "router" else f"{pod.name}.json"
            if name == own:
                for number, port in pod.ports.items():
                    text = text.replace(f'"metrics_port": {number}', f'"metrics_port": {port}')
                    text = text.replace(f"tcp/0.0.0.0:{number}", f"tcp/127.0.0.1:{port}")
                break
        return text.replace('"metrics_host": "0.0.0.0"', '"metrics_host": "127.0.0.1"')

    def _localize_paths(self, pod: Pod, container: Manifest, text: str) -> str:
        """Return a configuration text with the mount paths of a container replaced by paths below
        the pod's folder.
        """
        for mount in sorted(
            container.get("volumeMounts", []), key=lambda one: -len(one["mountPath"])
        ):
            if mount["mountPath"] != "/tmp":
                text = text.replace(mount["mountPath"], str(self._mount_folder(pod, mount)))
        return text.replace("/var/cache/gripmap", str(self.root / "image-cache"))

    @staticmethod
    def _mount_folder(pod: Pod, mount: Manifest) -> Path:
        return pod.root / str(mount["name"])

    def _fill_volumes(self, pod: Pod) -> None:
        """Write the files that a pod's volumes (configuration maps, secrets) contain into the
        folders that stand for the mounts.
        """
        volumes = {one["name"]: one for one in pod.template["spec"]["volumes"]}
        for container in [*pod.template["spec"].get("initContainers", []), *pod.containers]:
            for mount in container.get("volumeMounts", []):
                folder = self._mount_folder(pod, mount)
                folder.mkdir(parents=True, exist_ok=True)
                volume = volumes.get(mount["name"])
                if volume is None:
                    assert mount["name"] in pod.claims, f"{pod.name}: no volume {mount['name']}"
                elif "configMap" in volume:
                    for name, text in self._configs[volume["configMap"]["name"]].items():
                        (folder / name).write_text(self._localize_paths(pod, container, text))
                elif "secret" in volume:
                    self._unpack_certificates(pod, container, folder)

    def _unpack_certificates(self, pod: Pod, container: Manifest, folder: Path) -> None:
        """Write a pod's certificates as files into `folder`, which stands for the mount of a
        secret. The documentation has the command that puts the same files into the secret.
        """
        of = pod.name.rpartition("-")[0]
        for path in [*self.certificates.glob(f"{of}-*.*"), self.certificates / "trust.pem"]:
            (folder / path.name).write_text(self._localize_paths(pod, container, path.read_text()))

    def _container_command(self, pod: Pod, container: Manifest) -> list[str]:
        given = {one["name"]: self._environment_value(pod, one) for one in container.get("env", [])}
        words = [self._localize_paths(pod, container, word) for word in container["command"]]
        for name, value in given.items():
            words = [word.replace(f"$({name})", value) for word in words]
        words = [word.replace("0.0.0.0", "127.0.0.1") for word in words]
        return [str(pod.ports.get(int(word), word)) if word.isdecimal() else word for word in words]

    def _environment_value(self, pod: Pod, one: Manifest) -> str:
        if "value" in one:
            return str(one["value"])
        assert one["valueFrom"] == {"fieldRef": {"fieldPath": "metadata.name"}}
        return pod.name

    def _environment_of(
        self, pod: Pod, container: Manifest, secrets: dict[str, dict[str, str]]
    ) -> dict[str, str]:
        given = {one["name"]: self._environment_value(pod, one) for one in container.get("env", [])}
        for one in container.get("envFrom", []):
            given |= secrets[one["secretRef"]["name"]]
        return self._environment | {
            name: self._localize_paths(pod, container, value) for name, value in given.items()
        }

    @contextmanager
    def run_pods(self, bucket: BucketServer | None = None) -> Iterator[Cluster]:
        """Start every pod for the `with` block. Each probe succeeds before the block begins, and
        each pod must end cleanly after it.
        """
        kept = cache_root()
        image = self.root / "image-cache"
        image.mkdir()
        if kept is not None:  # an image contains compiled kernels
            (image / "gripmap").symlink_to(kept)
        secrets = {"bucket": _bucket_environment(bucket)} if bucket else {}
        started: list[tuple[Pod, Manifest, subprocess.Popen[bytes]]] = []
        with ExitStack() as stack:
            for pod in self.pods:
                self._fill_volumes(pod)
                for container in pod.template["spec"].get("initContainers", []):
                    done = subprocess.run(
                        self._container_command(pod, container),
                        capture_output=True,
                        text=True,
                        check=False,
                    )
                    if done.returncode:
                        self.failed.append(f"{pod.name}: {container['name']}: {done.stderr}")
                for container in pod.containers:
                    log = stack.enter_context((pod.root / f"{container['name']}.log").open("wb"))
                    environment = self._environment_of(pod, container, secrets)
                    process = subprocess.Popen(
                        self._container_command(pod, container),
                        cwd=pod.root,
                        env=environment,
                        stdout=log,
                        stderr=log,
                    )
                    started.append((pod, container, stack.enter_context(process)))
                    stack.callback(process.kill)
            for pod, container, process in started:
                self._await_probes(pod, container, process)
            yield self
            for pod, container, process in reversed(started):
                process.send_signal(signal.SIGTERM)
                try:
                    code = process.wait(pod.grace_s)
                except subprocess.TimeoutExpired:
                    code = -1
                if code:
                    self.failed.append(f"{pod.name}: {container['name']} left with {code}")

    def _await_probes(
        self, pod: Pod, container: Manifest, process: subprocess.Popen[bytes]
    ) -> None:
        """Wait until the container's probes succeed, the startup probe first, as a kubelet does."""
        names = [
            name
            for name in ("startupProbe", "readinessProbe", "livenessProbe")
            if name in container
        ]
        assert "readinessProbe" in names
        for name in names:
            has_ended_or_answers = partial(
                _has_ended_or, process, partial(has_answered, pod, container, container[name])
            )
            try:
                until(has_ended_or_answers, START_S)
            except TimeoutError:
                self.failed.append(f"{pod.name}: {name} never answered")
                return
            if process.poll() is not None:
                log = (pod.root / f"{container['name']}.log").read_text()[-2000:]
                self.failed.append(
                    f"{pod.name}: {container['name']} ended with {process.returncode}: {log}"
                )
                return

    def fetch_page(self, pod: Pod, path: str, port: str = "metrics") -> str:
        """Return a page of a pod's HTTP server, by default that of the metrics. The text is empty
        if the server does not answer. This happens while a standby (waiting service) takes over,
        because the standby's server then ends and the service's server starts.
        """
        (container,) = pod.containers
        address = f"http://127.0.0.1:{pod.port_of(container, port)}{path}"
        try:
            with urllib.request.urlopen(address, timeout=5.0) as page:
                return str(page.read().decode())
        except (OSError, http.client.HTTPException):
            # Connection refused or closed, or no answer in time.
            return ""


def _has_ended_or(process: subprocess.Popen[bytes], holds: Callable[[], bool]) -> bool:
    return process.poll() is not None or holds()


def has_answered(pod: Pod, container: Manifest, probe: Manifest) -> bool:
    """Send a health probe to a container of a simulated pod; return True if it succeeds."""
    if "tcpSocket" in probe:
        with socket.socket() as one:
            one.settimeout(1.0)
            return (
                one.connect_ex(("127.0.0.1", pod.port_of(container, probe["tcpSocket"]["port"])))
                == 0
            )
    asked = probe["httpGet"]
    try:
        address = f"http://127.0.0.1:{pod.port_of(container, asked['port'])}{asked['path']}"
        with urllib.request.urlopen(address, timeout=5.0) as page:
            return 200 <= int(page.status) < 400
    except (urllib.error.URLError, OSError):
        return False


def _bucket_environment(bucket: BucketServer) -> dict[str, str]:
    return {
        "AWS_ENDPOINT": bucket.store["endpoint"],
        "AWS_REGION": bucket.store["region"],
        "AWS_ALLOW_HTTP": "true",
        "AWS_ACCESS_KEY_ID": bucket.store["access_key_id"],
        "AWS_DISABLE_BULK_DELETE": "true",
        "AWS_SECRET_ACCESS_KEY": bucket.store["secret_access_key"],
    }


@contextmanager
def open_cluster(overlay: str, root: Path) -> Iterator[Cluster]:
    """Yield a simulated cluster in which the pods of an overlay (variant of the manifests) run,
    with a bucket if the pods need one.
    """
    made = Cluster(overlay, root)
    wanted = any("envFrom" in container for pod in made.pods for container in pod.containers)
    with ExitStack() as stack:
        bucket = stack.enter_context(bucket_server(root / "objects")) if wanted else None
        (root / "objects" / BUCKET).mkdir(parents=True, exist_ok=True)
        yield stack.enter_context(made.run_pods(bucket))


def main() -> int:
    """Validate every overlay (variant of the manifests), and start its pods. Return 1 if a figure
    misses its target, otherwise 0.
    """
    wrong = list[str]()
    failed = list[str]()
    objects = 0
    started = 0
    for overlay in OVERLAYS:
        found = build_overlay(overlay)
        objects += len(found)
        wrong += [f"{overlay}: {line}" for line in find_schema_errors(found)]
        with tempfile.TemporaryDirectory() as folder:
            began = time.monotonic()
            with open_cluster(overlay, Path(folder)) as running:
                started += len(running.pods)
            failed += [f"{overlay}: {line}" for line in running.failed]
            print(
                f"{overlay}: {len(found)} objects, {len(running.pods)} pods in "
                f"{time.monotonic() - began:.0f} s"
            )
    for line in (*wrong, *failed):
        print(line)
    figures = [
        Figure("kube.invalid", len(wrong), "of the objects", 0),
        Figure("kube.objects", objects, "objects"),
        Figure("kube.commands_failed", len(failed), "of the containers", 0),
        Figure("kube.pods", started, "pods started as processes", 13, "more"),
    ]
    write_figures(ROOT / ".kube" / "figures.json", "kube", [0], figures)
    print(format_table(figures))
    return int(not all(figure.holds for figure in figures))


if __name__ == "__main__":
    if shutil.which("kubectl") is None:
        sys.exit("error: kubectl: is not installed; it builds the manifests")
    sys.exit(main())
