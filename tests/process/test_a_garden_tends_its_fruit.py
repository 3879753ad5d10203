"""`garden up` as a newcomer starts it: within three minutes robots have looked at fruit and picked some."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from real_garden import UpGarden

from core.scenario import find

WITHIN_S = 180.0
"""Wall seconds from the command to the first fruit in a basket."""
RING_BGR = ((60, 200, 60), (30, 150, 240), (40, 40, 230))
RING_OFF = 40
"""A ring's colour in a JPEG is off by so much at most."""


def cpu_s(garden):
    """Processor time of all that runs for this garden [s]."""
    total = 0.0
    for pid in garden.pids():
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        total += (int(fields[11]) + int(fields[12])) / 100.0
    return total


def ringed(jpeg):
    """Pixels of a ring's colour."""
    image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR).astype(int)
    return sum(int((np.abs(image - np.array(colour)).max(axis=2) < RING_OFF).sum()) for colour in RING_BGR)


@pytest.mark.soak
@pytest.mark.alone
def test_within_three_minutes_there_were_scans_a_harvest_and_a_picture_with_rings(tmp_path):
    scenario = find("garden")
    began_s = time.monotonic()
    with UpGarden(tmp_path / "g", scenario, scenario.speed) as garden:
        garden.ready(90.0)
        ready_s = time.monotonic() - began_s
        pots = [plant.id for plant in scenario.plants]
        pictures: dict[str, bytes] = {}

        def scanned():
            return any(garden.get(pot, "/inventory")["scans"] for pot in pots)

        def looks():
            """A picture while a robot looks at its plant: at rest the hand may see nothing."""
            for robot in ("robot-1", "robot-2"):
                if garden.get(robot, "/state")["job"] == "act":
                    answer = garden.picture(robot)
                    if answer.headers["content-type"] == "image/jpeg" and ringed(answer.content) > 100:
                        pictures[robot] = answer.content
            return bool(pictures)

        def picked():
            looks() if not pictures else None
            return any(f.where == "basket" for plant in garden.truth().plants for f in plant.fruit)

        garden.until(scanned, WITHIN_S - (time.monotonic() - began_s))
        scan_s = time.monotonic() - began_s
        garden.until(picked, WITHIN_S - (time.monotonic() - began_s))
        pick_s = time.monotonic() - began_s
        print(f"ready {ready_s:.0f} s, scan {scan_s:.0f} s, fruit in a basket {pick_s:.0f} s, CPU {cpu_s(garden):.0f} s")
        if not pictures:
            garden.until(looks, 60.0)
        (tmp_path / "camera.jpg").write_bytes(next(iter(pictures.values())))
        words = ["plants", "--data", str(garden.folder.root)]
        told = subprocess.run([sys.executable, "-m", "console.cli", *words], capture_output=True, text=True, timeout=30.0)
        print(told.stdout)
        assert told.returncode == 0, told.stderr
        assert all(word in told.stdout for word in ("green", "turning", "red"))
        garden.unhurt()
        garden.ends()
