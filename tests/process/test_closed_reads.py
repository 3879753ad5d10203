"""With reads closed the garden still works: whoever reads shows a token, also the clocks and the eye."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import httpx
import pytest
from real_garden import RealGarden

from core.scenario import find

pytestmark = [pytest.mark.soak, pytest.mark.alone]
SERVICES = ("sim", "station", "plant-1", "robot-1-body", "robot-1", "console")


@pytest.mark.parametrize("tls", [False, True])
def test_a_garden_that_shows_strangers_nothing_lives_and_serves(tmp_path: Path, tls: bool) -> None:
    closed = {name: {"GARDEN_OPEN_READS": "false"} for name in SERVICES}
    scenario = find("garden").model_copy(update={"tls": tls})
    with RealGarden(tmp_path, scenario, 4.0, closed) as garden:
        garden.start(*SERVICES)
        for name in SERVICES:
            if name != "robot-1-body":
                garden.until(lambda n=name: bool(garden.get(n, "/readyz")["ready"]), 90.0)
        trusted = garden.folder.trusted() if tls else True
        for name in ("sim", "station", "plant-1", "robot-1", "console"):
            url = f"{'https' if tls else 'http'}://127.0.0.1:{garden.listed[name].port}"
            assert httpx.get(url + "/healthz", verify=trusted or True).status_code == 200
            for path in ("/", "/metrics", "/events", "/openapi.json"):
                assert httpx.get(url + path, verify=trusted or True).status_code == 401, (name, path)
        garden.until(lambda: garden.picture("robot-1").content.startswith(b"\xff\xd8"), 90.0)
        before_s = garden.get("plant-1", "/state")["now_s"]
        garden.until(lambda: bool(garden.get("plant-1", "/state")["now_s"] > before_s + 2.0), 20.0)
        seen = garden.get("console", "/api/garden")
        assert {each["plant_id"] for each in seen["plants"]} == {"plant-1"}
        assert {each["robot_id"] for each in seen["robots"]} == {"robot-1"}
        wished = garden.post("plant-1", "/tasks", {"kind": "water", "dose_ml": 30.0})
        assert wished.status_code in (201, 409), wished.text
        garden.until(lambda: any(task["robot_id"] == "robot-1" for task in garden.get("plant-1", "/tasks")), 60.0)
        url = f"{'https' if tls else 'http'}://127.0.0.1:{garden.listed['robot-1'].port}"
        peers = json.dumps([{"id": "robot-1", "kind": "robot", "url": url}])
        words = [sys.executable, "-m", "console.cli", "robots", "--data", str(garden.folder.root), "--json"]
        env = os.environ | {"GARDEN_PEERS": peers, "GARDEN_READS_AS": "operator"}
        told = subprocess.run(words, env=env, capture_output=True, text=True, timeout=60, check=True)
        assert [each["robot_id"] for each in json.loads(told.stdout)] == ["robot-1"]
