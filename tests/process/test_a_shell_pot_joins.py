"""The example of docs/protocol.md, a pot in shell behind lighttpd, beside real services: it asks for water and gets it."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from signal import SIGTERM

import httpx
import pytest
from real_garden import RealGarden

from core.scenario import Scenario, device_ports, load
from core.wire.documents import NodeCard
from core.wire.market import Task
from core.wire.plant import DockState, PlantState
from lab import story

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "cgi-pot"
SEARCHED = f"{Path('/usr/sbin')}:/usr/bin:/bin:/usr/local/bin"
MISSING = [tool for tool in ("lighttpd", "php", "php-cgi", "curl", "flock") if shutil.which(tool, path=SEARCHED) is None]
SPEED = 5.0
NAME = "plant-5"
DOSE_ML = 120.0
"""The soil of three litres rises by four hundredths, well beyond the target."""


def with_one_neighbour(scenario: Scenario) -> Scenario:
    """The example's garden with one moist pot, and one robot, beside the one in shell."""
    plants = [story.moist(scenario.plants[0]), scenario.plants[-1]]
    near = scenario.robots[0].model_copy(update={"x_m": 1.10, "y_m": 0.60, "yaw_deg": -90.0})
    return story.water_only(scenario.model_copy(update={"plants": tuple(plants), "robots": (near,)}))


def settings(garden: RealGarden, port: int) -> str:
    """The example's own, moved to where this garden is."""
    root, world = garden.folder.root, garden.listed["sim"].port
    soil = device_ports(garden.scenario)[f"{NAME}.soil"]
    ours = {
        "port": str(port),
        "data": f'"{root / NAME}"',
        "keys": f'"{garden.folder.keys / NAME}"',
        "peers": f'"{root}/peers.json"',
        "clock": f'"http://127.0.0.1:{world}"',
        "probe": f'"socket://127.0.0.1:{soil}?pin=0"',
        "dose_ml": f"{DOSE_ML:g}",
        "target_ratio": "0.202",
        "soak_s": "20",
        "tick_s": "0.5",
    }
    text = (EXAMPLE / "pot.ini").read_text()
    for name, value in ours.items():
        text, found = re.subn(rf"^{name} = .*", f"{name} = {value}", text, flags=re.MULTILINE)
        assert found == 1, name
    return text


@contextmanager
def running(garden: RealGarden, port: int) -> Iterator[str]:
    """The pot in shell; its URL."""
    garden.folder.remember(garden.scenario)
    ini = garden.folder.root / "pot.ini"
    ini.write_text(settings(garden, port))
    out = (garden.folder.root / "pot.out").open("wb")
    environment = {"POT_INI": str(ini), "PATH": SEARCHED}
    pot = subprocess.Popen([str(EXAMPLE / "run")], env=environment, stdout=out, stderr=out)
    try:
        yield f"http://127.0.0.1:{port}"
    finally:
        pot.send_signal(SIGTERM)
        assert pot.wait(10) == 0
        out.close()
        print((garden.folder.root / "pot.out").read_text())


@pytest.mark.soak
@pytest.mark.alone
@pytest.mark.skipif(bool(MISSING), reason=f"the example needs {', '.join(MISSING)}: see examples/cgi-pot/README.md")
def test_a_pot_in_shell_joins_the_garden_asks_for_water_and_gets_it(tmp_path):
    scenario = with_one_neighbour(load(EXAMPLE / "garden.toml"))
    with RealGarden(tmp_path / "g", scenario, SPEED) as garden:
        port = garden.scenario.ports.plants + len(garden.scenario.plants) - 1
        garden.start("sim", "plant-1", "robot-1-body", "robot-1")
        garden.until(lambda: garden.get("robot-1", "/readyz")["ready"], 60.0)
        with running(garden, port) as url, httpx.Client(base_url=url, timeout=5.0) as http:

            def told(path: str) -> bytes:
                return http.get(path).raise_for_status().content

            garden.until(lambda: b"true" in told("/readyz"), 20.0)
            assert NodeCard.model_validate_json(told("/")).id == NAME
            dry = PlantState.model_validate_json(told("/state"))
            tasks: list[Task] = []

            def done() -> bool:
                tasks[:] = [
                    Task.model_validate_json(told(f"/tasks/{task['task_id']}")) for task in http.get("/tasks").json()
                ]
                return bool(tasks) and tasks[0].state in ("done", "failed")

            garden.until(done, 120.0)
            task = tasks[0]
            print("\n".join(f"{event.t_s:8.1f}  {event.what}" for event in task.events))
            assert (task.state, task.robot_id, task.epoch, task.permits) == ("done", "robot-1", 1, 1)
            wet = PlantState.model_validate_json(told("/state"))
            [DockState.model_validate(dock) for dock in http.get("/dock").json()]
        truth = garden.truth().plant(NAME)
        assert 0.9 * DOSE_ML < truth.poured_ml <= (1 + story.PUMP_ERROR_RATIO) * DOSE_ML
        assert task.delivered_ml is not None
        assert task.delivered_ml <= (1 + story.PUMP_ERROR_RATIO) * DOSE_ML
        assert truth.moisture_ratio > story.DRY_RATIO + 0.03
        assert dry.thirsty
        assert dry.soil.ratio is not None
        assert wet.soil.ratio is not None
        assert wet.soil.ratio > dry.soil.ratio + 0.01
        assert not wet.thirsty
        garden.unhurt()
