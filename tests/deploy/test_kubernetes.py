"""Tests of the manifests for Kubernetes: they follow its schemas, every reference resolves, and the
pods' commands run.

`tests.deploy.kubernetes` starts the commands. Nothing is applied to a cluster.
"""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest
import zenoh

from fleet_service.enrolment.fleet import Enrolment
from schemas.config import ServiceConfig, ZenohSettings, load_config
from schemas.runtime import presence
from schemas.runtime.zenoh_session import open_session
from tests.deploy import kubernetes
from tests.deploy.kubernetes import OVERLAYS, Cluster, Manifest, build_overlay, of_kind
from tests.structure import ROOT
from tests.waiting import until

pytestmark = pytest.mark.skipif(
    shutil.which("kubectl") is None, reason="kubectl, which builds the manifests, is not here"
)
SECRETS = {  # documented secrets of each overlay
    "one-node": set(),
    "secure": {"router-certs", "service-certs", "page-certs"},
    "three-regions": {
        "router-certs",
        "page-certs",
        "north-certs",
        "middle-certs",
        "south-certs",
        "bucket",
    },
}


def list_templates(objects: list[Manifest]) -> list[Manifest]:
    return [one["spec"]["template"] for one in of_kind(objects, "StatefulSet")]


def labels_of(objects: list[Manifest]) -> list[dict[str, str]]:
    return [template["metadata"]["labels"] for template in list_templates(objects)]


def does_select(selector: dict[str, str], labels: dict[str, str]) -> bool:
    return selector.items() <= labels.items()


@pytest.mark.parametrize("overlay", OVERLAYS)
def test_manifests_are_valid_by_the_kubernetes_schemas(overlay: str) -> None:
    objects = build_overlay(overlay)
    assert len(objects) >= 8
    assert kubernetes.find_schema_errors(objects) == []
    wrong = json.loads(json.dumps(objects))
    (of_kind(wrong, "StatefulSet")[0]["spec"])["replica"] = 1
    assert len(kubernetes.find_schema_errors(wrong)) == 1, "a name that is none is found"


@pytest.mark.parametrize("overlay", OVERLAYS)
def test_every_reference_has_a_target(overlay: str) -> None:
    objects = build_overlay(overlay)
    labels = labels_of(objects)
    secrets = set()
    configs = {one["metadata"]["name"] for one in of_kind(objects, "ConfigMap")}
    services = {one["metadata"]["name"]: one for one in of_kind(objects, "Service")}
    for one in of_kind(objects, "StatefulSet"):
        assert one["spec"]["serviceName"] in services
        assert does_select(
            one["spec"]["selector"]["matchLabels"], one["spec"]["template"]["metadata"]["labels"]
        )
        volumes = one["spec"]["template"]["spec"]["volumes"]
        assert {
            volume["configMap"]["name"] for volume in volumes if "configMap" in volume
        } <= configs
        secrets |= {volume["secret"]["secretName"] for volume in volumes if "secret" in volume}
        for container in one["spec"]["template"]["spec"]["containers"]:
            secrets |= {given["secretRef"]["name"] for given in container.get("envFrom", [])}
    assert secrets == SECRETS[overlay]
    for service in services.values():
        wanted = dict(service["spec"]["selector"])
        pod = wanted.pop("statefulset.kubernetes.io/pod-name", None)
        assert pod in {None, "router-0", "router-1"}
        assert pod or sum(does_select(wanted, one) for one in labels) == 1, service["metadata"][
            "name"
        ]
    for budget in of_kind(objects, "PodDisruptionBudget"):
        assert (
            sum(does_select(budget["spec"]["selector"]["matchLabels"], one) for one in labels) == 1
        )


@pytest.mark.parametrize("overlay", OVERLAYS)
def test_network_policies_reach_routers_but_never_services(overlay: str) -> None:
    """Each pod must reach the routers, but no other pod may reach a service except for its metrics.
    The test evaluates the policies as a cluster does: a pod may do everything that any policy
    selecting it allows.
    """
    objects = build_overlay(overlay)
    policies = [one["spec"] for one in of_kind(objects, "NetworkPolicy")]
    (router,) = (
        one for one in labels_of(objects) if one["app.kubernetes.io/component"] == "router"
    )
    for labels in labels_of(objects):
        own = [one for one in policies if does_select(one["podSelector"]["matchLabels"], labels)]
        assert own, "whom no policy selects anybody reaches"
        assert all(set(one["policyTypes"]) == {"Ingress", "Egress"} for one in own)
        ways = [rule for one in own for rule in one["egress"] if {"port": 7447} in rule["ports"]]
        to = [peer["podSelector"].get("matchLabels", {}) for rule in ways for peer in rule["to"]]
        assert any(does_select(one, router) for one in to), labels
        port = {"service": 9464, "page": 8080}.get(labels["app.kubernetes.io/component"])
        if port is not None and overlay != "one-node":
            let_in = [rule for one in own for rule in one["ingress"]]
            assert [rule["ports"] for rule in let_in] == [[{"port": port}]]
            assert all("namespaceSelector" in peer for rule in let_in for peer in rule["from"])


@pytest.mark.parametrize("overlay", OVERLAYS)
def test_every_container_is_shut_in_and_bounded(overlay: str) -> None:
    """The containers must satisfy the restricted profile of the pod security standards, which the
    namespace enforces. They must also have limits of memory and a read-only file system.
    """
    for template in list_templates(build_overlay(overlay)):
        pod = template["spec"]
        assert pod["securityContext"]["runAsNonRoot"] is True
        assert pod["securityContext"]["runAsUser"] == 10001
        assert pod["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
        assert pod["automountServiceAccountToken"] is False
        for container in [*pod.get("initContainers", []), *pod["containers"]]:
            own = container["securityContext"]
            assert (own["allowPrivilegeEscalation"], own["readOnlyRootFilesystem"]) == (False, True)
            assert own["capabilities"] == {"drop": ["ALL"]}
            assert "memory" in container["resources"]["limits"]
            assert {"cpu", "memory"} <= set(container["resources"]["requests"])
            assert container["image"] == "gripmap:0.1.0"
            assert {mount["name"] for mount in container["volumeMounts"]} <= {
                volume["name"] for volume in pod["volumes"]
            } | {"state"}


@pytest.mark.parametrize("overlay", OVERLAYS)
def test_each_pod_has_settings_of_its_own_name_and_is_on_the_list(
    overlay: str, tmp_path: Path
) -> None:
    made = Cluster(overlay, tmp_path)
    listed = load_config(tmp_path / "fleet.json", Enrolment) if overlay != "one-node" else None
    # Configuration files as they are shipped.
    configs = {
        name: text
        for one in of_kind(made.objects, "ConfigMap")
        for name, text in one["data"].items()
    }
    regions: dict[str, list[str]] = {}
    for pod in made.pods:
        if pod.component == "router":
            assert listed is None or pod.name in listed.routers
            continue
        if pod.component == "page":
            assert listed is None or pod.name in listed.readers
            continue
        config = ServiceConfig.model_validate_json(configs[f"{pod.name}.json"])
        assert config.name == pod.name
        assert (config.metrics_host, config.metrics_port) == ("0.0.0.0", 9464), (
            "a kubelet asks from outside of the pod"
        )
        assert listed is None or pod.name in listed.services
        regions.setdefault(pod.name.rpartition("-")[0], []).append(
            json.dumps([config.regions, config.archive.second])
        )
    assert all(len(set(own)) == 1 for own in regions.values()), (
        "who follows has the regions and the bucket of who leads"
    )
    assert len({own[0] for own in regions.values()}) == len(regions)
    if listed is not None:
        assert [
            name for name in listed.services if name not in {pod.name for pod in made.pods}
        ] == []


@pytest.mark.campaign
@pytest.mark.parametrize("overlay", OVERLAYS)
def test_processes_of_the_pods_work_together_and_end_in_time(overlay: str, tmp_path: Path) -> None:
    with kubernetes.open_cluster(overlay, tmp_path) as running:
        assert running.failed == []
        services = [pod for pod in running.pods if pod.component == "service"]

        def list_serving() -> list[str]:
            found = [
                pod
                for pod in services
                if re.search(r"^gripmap_serves\{.*\} 1", running.fetch_page(pod, "/metrics"), re.M)
            ]
            return [pod.name.rpartition("-")[0] for pod in found]

        wanted = sorted({pod.name.rpartition("-")[0] for pod in services})
        until(lambda: sorted(list_serving()) == wanted, 120.0)
        (page,) = (pod for pod in running.pods if pod.component == "page")
        until(lambda: json.loads(running.fetch_page(page, "/health", "http"))["router"], 120.0)
        with open_reader(running) as session:
            until(
                lambda: (
                    len({token.region for token in presence.active_tokens(session)})
                    == sum(
                        len(json.loads(read_settings(running, f"{name}-0"))["regions"])
                        if overlay == "three-regions"
                        else 1
                        for name in wanted
                    )
                )
            )
    assert running.failed == []


def read_settings(running: Cluster, pod: str) -> str:
    return (running.root / pod / "config" / f"{pod}.json").read_text()


def open_reader(running: Cluster) -> zenoh.Session:
    """Return a reader's Zenoh session at the routers, with its own certificate if the routers
    require one.
    """
    name = next(pod.name for pod in running.pods if pod.component == "service")
    shipped = ServiceConfig.model_validate_json(read_settings(running, name)).zenoh
    config = {"connect": shipped.connect}
    if running.overlay != "one-node":
        tls = json.loads((ROOT / "deploy" / "secure" / "reader.json").read_text())["zenoh"][
            "config"
        ]
        config["config"] = json.loads(
            json.dumps(tls).replace("/etc/gripmap/certs", str(running.certificates))
        )
    session = open_session(ZenohSettings.model_validate(config), None, "reader-0")
    assert session is not None
    return session
