"""`garden up` with `tls = true`: a pot is served as ever, and a token that was read somewhere opens nothing."""

from __future__ import annotations

import json
import subprocess
import sys

import httpx
import pytest
from real_garden import UpGarden

from core.mesh import tls
from core.mesh.auth import Identity
from lab import story

pytestmark = pytest.mark.alone

FAST = 8.0


def test_a_pot_is_watered_by_a_robot_that_showed_its_certificate(tmp_path):
    scenario = story.water_only(story.one_pot()).model_copy(update={"tls": True})
    with UpGarden(tmp_path / "g", scenario, FAST) as garden:
        garden.ready(90.0)
        urls = [peer.url for peer in garden.folder.peers()]
        assert urls
        assert all(url.startswith("https://") for url in urls)
        garden.until(lambda: garden.robot().pumping, 120.0)
        task = garden.served("plant-1", 120.0)
        assert 0.0 < garden.poured_ml("plant-1") <= story.allowed_ml(task)
        # The world's first picture takes its time.
        garden.until(lambda: garden.picture("robot-1").content.startswith(b"\xff\xd8"), 60.0)
        garden.unhurt()

        words = [sys.executable, "-m", "console.cli", "plants", "--data", str(garden.folder.root), "--json"]
        asked = subprocess.run(words, capture_output=True, text=True, timeout=60, check=True)
        assert [plant["plant_id"] for plant in json.loads(asked.stdout)] == ["plant-1"]

        read = Identity.load(garden.folder.keys / "robot-1").token
        bid = {"plant_id": "plant-1", "robot_id": "robot-1"}
        with httpx.Client(headers={"authorization": f"Bearer {read}"}, verify=garden.folder.trusted()) as thief:
            pot = next(peer.url for peer in garden.folder.peers() if peer.id == "plant-1")
            refused = thief.post(f"{pot}/dock/reservations", json=bid)
            assert refused.status_code == 401
            assert "nobody showed a certificate" in refused.json()["detail"]
        with pytest.raises(httpx.HTTPError):
            httpx.get(pot.replace("https://", "http://") + "/state")
        assert not (garden.folder.keys / "operator" / tls.KEY).exists()
        garden.ends()
        assert garden.pids() == []
