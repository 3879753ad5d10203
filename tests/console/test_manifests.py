"""The Kubernetes manifests hold what they promise, judged by Kubernetes' own schemas."""

from __future__ import annotations

import json
from copy import deepcopy
from pathlib import Path
from typing import Any

import kubernetes_validate
import pytest
import yaml

from console.kubernetes import manifests
from core.errors import ConfigError
from core.scenario import device_ports, find

ROOT = Path(__file__).resolve().parents[2]
TEXT = (ROOT / "deploy" / "garden.yaml").read_text()
OBJECTS: list[dict[str, Any]] = list(yaml.safe_load_all(TEXT))
SETS = {each["metadata"]["name"]: each for each in OBJECTS if each["kind"] == "StatefulSet"}
POLICIES = {each["metadata"]["name"]: each["spec"] for each in OBJECTS if each["kind"] == "NetworkPolicy"}


def judge(document: dict[str, Any]) -> None:
    kubernetes_validate.validate(document, kubernetes_validate.latest_version(), strict=True)


def containers() -> list[dict[str, Any]]:
    return [container for each in SETS.values() for container in each["spec"]["template"]["spec"]["containers"]]


def test_the_checked_in_file_is_what_the_command_writes() -> None:
    assert manifests("garden") == TEXT


def test_kubernetes_has_nothing_against_any_object() -> None:
    for document in OBJECTS:
        judge(document)


@pytest.mark.parametrize(("where", "bad"), [("replica", 1), ("replicas", "one"), ("updateStrategy", "none")])
def test_kubernetes_would_find_a_slip(where: str, bad: object) -> None:
    document = deepcopy(SETS["plant-1"])
    document["spec"][where] = bad
    with pytest.raises(kubernetes_validate.ValidationError):
        judge(document)


def test_every_node_is_a_set_with_a_volume_and_keys_of_its_own() -> None:
    scenario = find("garden")
    nodes = {plant.id for plant in scenario.plants} | {robot.id for robot in scenario.robots}
    assert set(SETS) == nodes | {"sim", "station", "console"}
    for node, each in SETS.items():
        pod = each["spec"]["template"]["spec"]
        secrets = {volume["secret"]["secretName"] for volume in pod["volumes"] if "secret" in volume}
        assert secrets == {f"keys-{node}"} | ({"keys-operator"} if node == "console" else set())
        assert [claim["metadata"]["name"] for claim in each["spec"]["volumeClaimTemplates"]] == ["data"]
        assert each["spec"]["replicas"] == 1


def test_a_robots_brain_and_body_share_a_pod_and_a_socket_and_nothing_else_does() -> None:
    for node, each in SETS.items():
        names = [container["name"] for container in each["spec"]["template"]["spec"]["containers"]]
        assert names == ([f"{node}-body", node] if node.startswith("robot") else [node])
    mounted = [c["name"] for c in containers() if any(mount["name"] == "socket" for mount in c["volumeMounts"])]
    assert mounted == ["robot-1-body", "robot-1", "robot-2-body", "robot-2"]


def test_whatever_answers_http_is_probed_and_nothing_runs_with_more_rights_than_it_needs() -> None:
    for container in containers():
        assert ("livenessProbe" in container) is ("ports" in container)
        if container["name"] == "console":
            assert container["livenessProbe"]["exec"]["command"] == ["python", "-m", "console.health"]
        elif "ports" in container:
            assert container["readinessProbe"]["httpGet"]["path"] == "/readyz"
            assert container["livenessProbe"]["httpGet"]["path"] == "/healthz"
        assert container["securityContext"] == {"allowPrivilegeEscalation": False, "capabilities": {"drop": ["ALL"]}}
        assert container["resources"]["limits"]["memory"]
    for each in SETS.values():
        assert each["spec"]["template"]["spec"]["securityContext"]["runAsNonRoot"] is True
        assert each["spec"]["template"]["spec"]["automountServiceAccountToken"] is False


def test_reads_are_open_on_loopback_only() -> None:
    for container in containers():
        env = {each["name"]: each["value"] for each in container["env"]}
        closed = env.get("GARDEN_OPEN_READS") == "false"
        assert closed or env["GARDEN_HOST"] == "127.0.0.1", container["name"]
        assert closed or container["name"] == "console"


def test_nobody_comes_in_but_the_garden_itself_and_device_wires_are_their_owners() -> None:
    assert POLICIES["nobody"] == {"podSelector": {}, "policyTypes": ["Ingress"]}
    assert all(
        source["podSelector"]["matchLabels"] == {"app.kubernetes.io/part-of": "robot-garden"}
        for name in ("mesh", "device-wires")
        for rule in POLICIES[name]["ingress"]
        for source in rule["from"]
    )
    wires = {port["port"] for rule in POLICIES["device-wires"]["ingress"] for port in rule["ports"]}
    mesh = {port["port"] for rule in POLICIES["mesh"]["ingress"] for port in rule["ports"]}
    assert wires == set(device_ports(find("garden")).values())
    assert not wires & mesh


def test_a_scenario_that_is_not_in_the_image_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="image"):
        manifests(str(tmp_path / "mine.toml"))


def test_under_tls_probes_shake_hands_too() -> None:
    objects = list(yaml.safe_load_all(manifests("garden", tls=True)))
    told = [json.dumps(each) for each in objects if each["kind"] == "StatefulSet"]
    assert len(told) == len(SETS)
    for document in objects:
        judge(document)
    assert all(text.count('"httpGet"') == text.count('"scheme": "HTTPS"') for text in told)
    assert sum('"httpGet"' in text for text in told) == len(told) - 1, "all but the console's"
    assert not any("http://" in text for text in told)
