"""The compose file and the Dockerfile hold what they promise."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from copy import deepcopy
from importlib.resources import files
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]
DOCUMENT: dict[str, Any] = yaml.safe_load((ROOT / "docker-compose.yml").read_text())
SERVICES: dict[str, Any] = {name: service for name, service in DOCUMENT["services"].items() if name != "init"}
KNOWN = {
    "image", "build", "command", "user", "network_mode", "environment", "volumes", "ports", "healthcheck", "depends_on",
    "restart", "cap_drop", "security_opt",
}  # fmt: skip


SCHEMA: dict[str, Any] = json.loads(
    files("check_jsonschema").joinpath("builtin_schemas", "vendor", "compose-spec.json").read_text()
)
"""The compose specification's own, as `check-jsonschema` carries it; so nothing is fetched."""


def judged(document: object) -> list[str]:
    """What the compose specification has against a document: paths of what is wrong."""
    judge = jsonschema.validators.validator_for(SCHEMA)(SCHEMA)
    return sorted(error.json_path for error in judge.iter_errors(document))


def mounts(service: dict[str, Any]) -> dict[str, str]:
    """Target to volume."""
    return {volume.split(":")[1]: volume.split(":")[0] for volume in service["volumes"]}


def test_the_compose_specification_has_nothing_against_it() -> None:
    assert judged(DOCUMENT) == []


@pytest.mark.parametrize(
    ("key", "bad"),
    [
        ("restarts", "always"),
        ("depends_on", {"sim": {"condition": "service_happy"}}),
        ("healthcheck", {"start_interval": 1.5}),
        ("cap_drop", "ALL"),
    ],
)
def test_the_compose_specification_would_find_a_slip(key: str, bad: object) -> None:
    document = deepcopy(DOCUMENT)
    document["services"]["plant-1"][key] = bad
    assert any(path.startswith("$.services") for path in judged(document))


def test_only_known_keys_and_one_image() -> None:
    assert set(DOCUMENT) == {"name", "services", "volumes"}
    for service in DOCUMENT["services"].values():
        assert set(service) <= KNOWN
        assert service["image"] == "robot-garden"


@pytest.mark.parametrize("name", SERVICES)
def test_ports_are_published_on_loopback_only(name: str) -> None:
    for port in SERVICES[name].get("ports", []):
        assert re.fullmatch(r"127\.0\.0\.1:(\d+):\1", port)


@pytest.mark.parametrize("name", SERVICES)
def test_a_node_sees_only_its_own_keys_and_cannot_change_them(name: str) -> None:
    keys = [volume for volume in SERVICES[name]["volumes"] if volume.startswith("keys-")]
    own = name.removesuffix("-body")
    assert f"keys-{own}:/keys:ro" in keys
    assert keys == [f"keys-{own}:/keys:ro"] or name == "console"
    assert "keys-garden" not in str(keys)


@pytest.mark.parametrize("name", SERVICES)
def test_a_service_comes_back_after_init_and_in_order(name: str) -> None:
    service = SERVICES[name]
    assert service["restart"] == "unless-stopped"
    assert service["depends_on"]["init"] == {"condition": "service_completed_successfully"}
    for other in set(service["depends_on"]) - {"init"}:
        assert other in SERVICES
    if name != "sim":
        assert service["depends_on"]["sim"] == {"condition": "service_healthy"}
    if "ports" in service:
        assert service["healthcheck"]["test"][-1] == "console.health"


def test_every_pot_has_a_named_volume_of_its_own() -> None:
    volumes = [mounts(service)["/data"] for service in SERVICES.values()]
    assert len(set(volumes)) == len(volumes)
    assert set(DOCUMENT["volumes"]) >= set(volumes)


def test_brain_and_body_share_one_socket() -> None:
    for robot in ("robot-1", "robot-2"):
        assert mounts(SERVICES[robot])["/run/robot"] == mounts(SERVICES[f"{robot}-body"])["/run/robot"]


def test_the_dockerfile_is_linted_and_needs_nothing_special() -> None:
    text = (ROOT / "Dockerfile").read_text()
    assert not re.search(r"^#\s*syntax|@sha256", text, re.MULTILINE)
    assert re.search(r"^USER 10001:10001$", text, re.MULTILINE)
    hadolint = shutil.which("hadolint", path=str(Path(sys.executable).parent))
    assert hadolint is not None
    done = subprocess.run([hadolint, str(ROOT / "Dockerfile")], capture_output=True, text=True, check=False)
    assert done.stdout + done.stderr == ""
    assert done.returncode == 0
