"""The compose file in a real engine: built, started, used, hurt, taken down. Only by `make test-compose`."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.compose

ROOT = Path(__file__).resolve().parents[2]
PROJECT = "garden-test"
"""Its own project, so that nobody's garden is taken down with its volumes."""
UP_WITHIN_S = 900
DONE_WITHIN_S = 480
IMAGE_MB_MAX = 1100


def compose(*words: str, within_s: float = 120) -> str:
    command = ["docker", "compose", "-p", PROJECT, *words]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=within_s, check=False)
    assert done.returncode == 0, f"{' '.join(command)}\n{done.stdout[-2000:]}\n{done.stderr[-4000:]}"
    return done.stdout


def engine_missing() -> str:
    """Why there is no engine to test with, or nothing."""
    for words in (["docker", "version"], ["docker", "compose", "version"]):
        try:
            done = subprocess.run(words, capture_output=True, text=True, timeout=30, check=False)
        except FileNotFoundError:
            return "there is no docker command"
        if done.returncode != 0:
            return f"`{' '.join(words)}`: {(done.stderr.strip().splitlines() or ['failed'])[-1]}"
    return ""


@pytest.fixture(scope="module")
def garden() -> Iterator[None]:
    if why := engine_missing():
        pytest.skip(f"no container engine: {why}; set DOCKER_HOST to one")
    began_s = time.monotonic()
    try:
        compose("up", "-d", "--build", "--wait", within_s=UP_WITHIN_S)
        print(f"\nup and healthy after {time.monotonic() - began_s:.0f} s")
        yield
    finally:
        compose("logs", "--tail", "20")
        compose("down", "-v", "-t", "5", within_s=180)


def get(url: str) -> Any:
    with urllib.request.urlopen(url, timeout=10) as answer:
        return json.load(answer)


def post(url: str, document: dict[str, Any], token: str = "") -> Any:
    headers = {"content-type": "application/json"} | ({"authorization": f"Bearer {token}"} if token else {})
    request = urllib.request.Request(url, json.dumps(document).encode(), headers)
    with urllib.request.urlopen(request, timeout=10) as answer:
        return json.load(answer)


def until(true: Callable[[], Any], within_s: float, what: str) -> Any:
    end_s = time.monotonic() + within_s
    while time.monotonic() < end_s:
        try:
            if found := true():
                return found
        except OSError:
            pass
        time.sleep(0.5)
    raise AssertionError(f"not within {within_s:g} s: {what}\n{compose('logs', '--tail', '15')[-6000:]}")


def container(name: str) -> dict[str, Any]:
    ids = compose("ps", "-q", name).split()
    told = subprocess.run(["docker", "inspect", *ids], capture_output=True, text=True, timeout=30, check=True)
    described: dict[str, Any] = json.loads(told.stdout)[0]
    return described


def healthy(name: str) -> bool:
    state = container(name)["State"]
    return bool(state["Running"]) and state["Health"]["Status"] == "healthy"


def test_the_image_is_small_enough(garden: None) -> None:
    told = subprocess.run(
        ["docker", "image", "inspect", "robot-garden"], capture_output=True, text=True, timeout=30, check=True
    )
    size_mb = json.loads(told.stdout)[0]["Size"] / 1e6
    print(f"image: {size_mb:.0f} MB")
    assert size_mb <= IMAGE_MB_MAX


def test_a_change_without_a_token_is_refused(garden: None) -> None:
    with pytest.raises(urllib.error.HTTPError) as caught:
        post("http://127.0.0.1:8103/tasks", {"kind": "water", "dose_ml": 60})
    with caught.value as error:
        assert error.code == 401
        assert error.headers["content-type"] == "application/problem+json"


def test_a_pot_is_watered_over_its_published_port(garden: None) -> None:
    token = compose("exec", "-T", "console", "garden", "token").strip()
    before = get("http://127.0.0.1:8103/state")["soil"]["ratio"]
    task = post("http://127.0.0.1:8103/tasks", {"kind": "water", "dose_ml": 60}, token)
    url = f"http://127.0.0.1:8103/tasks/{task['task_id']}"
    began_s = time.monotonic()
    done = until(lambda: ended(get(url)), DONE_WITHIN_S, f"{task['task_id']} ends")
    after = get("http://127.0.0.1:8103/state")["soil"]["ratio"]
    print(f"{done['state']} by {done['robot_id']} after {time.monotonic() - began_s:.0f} s: {before:.3f} -> {after:.3f}")
    assert done["state"] == "done", done
    assert after > before + 0.005


def ended(task: dict[str, Any]) -> dict[str, Any] | None:
    return task if task["state"] in ("done", "failed", "cancelled") else None


@pytest.mark.parametrize("name", ["plant-2", "robot-1-body"])
def test_a_killed_container_comes_back(garden: None, name: str) -> None:
    before = container(name)
    # `docker kill` would count as the operator's wish and not be restarted; a process that dies is.
    os.kill(before["State"]["Pid"], signal.SIGKILL)
    until(lambda: container(name)["RestartCount"] > before["RestartCount"], 60, f"{name} restarts")
    if name == "plant-2":
        until(lambda: healthy(name), 120, f"{name} is healthy again")
        assert get("http://127.0.0.1:8102/readyz")["ready"] is True
    else:
        until(lambda: get("http://127.0.0.1:8201/readyz"), 120, "robot-1 has its body again")
