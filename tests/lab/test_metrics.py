"""docs/metrics.md lists what the services tell, and a watering moves a robot's and a station's numbers."""

from __future__ import annotations

import asyncio
import re
from pathlib import Path

from core.mesh.auth import TOKEN_LIFE_S
from core.mesh.metrics import LoopLag
from lab import story
from lab.garden import Garden

DOC = (Path(__file__).resolve().parents[2] / "docs" / "metrics.md").read_text()
_LINE = re.compile(r"^(\w+)(?:\{(.*)\})? (\S+)$")
ONLY_IN_PROCESSES = {"garden_loop_lag_seconds"}
"""The lab's services share one loop, whose time jumps."""
ONLY_WHERE_FLOODED = {"garden_parcels_total"}
"""`tests/mesh/test_parcels.py` looks at them."""


def listed() -> set[str]:
    rows = re.findall(r"^\| (`[^|]+`) \|", DOC, re.MULTILINE)
    return {name for row in rows for name in re.findall(r"`(\w+)`", row)}


def values(text: str) -> dict[str, float]:
    """Name with labels -> value."""
    found = (_LINE.match(line) for line in text.splitlines())
    return {f"{m[1]}{{{m[2]}}}" if m[2] else m[1]: float(m[3]) for m in found if m is not None}


def families(text: str) -> set[str]:
    """Names that `# TYPE` lines declare, the runtime's own left out."""
    types = dict(re.findall(r"^# TYPE (\w+) (\w+)$", text, re.MULTILINE))
    told = {f"{name}_total" if kind == "counter" and not name.endswith("_total") else name for name, kind in types.items()}
    return {name for name in told if not name.endswith("_created")}


def test_the_list_holds_what_the_services_tell_and_a_watering_moves_a_robots_numbers() -> None:
    async def play(garden: Garden) -> None:
        async def metrics(name: str) -> str:
            async with garden.operator() as http:
                return (await http.get(garden.url(name) + "/metrics")).raise_for_status().text

        async def told(name: str) -> dict[str, float]:
            return values(await metrics(name))

        await story.phase(garden, "plant-1", "navigate")
        before = await told("robot-1")
        assert before["garden_queue_length"] == before["garden_queue_running"] == before["garden_position_known"] == 1
        assert before["garden_estop_latched"] == before["garden_charging"] == before["garden_body_down"] == 0
        assert before["garden_docks_held"] == 1
        assert before["garden_parts_failed"] == 0
        assert before['garden_peers{present="true"}'] > 0 == before['garden_peers{present="false"}']
        assert 0 < before["garden_token_left_seconds"] <= TOKEN_LIFE_S
        assert before["garden_position_sigma_m"] > 0
        await story.phase(garden, "plant-1", "act")
        assert (await told("robot-1"))["garden_charging"] == 1
        await story.served(garden, "plant-1")
        after = await told("robot-1")
        assert after["garden_queue_length"] == 0
        assert after["garden_tank_ml"] < before["garden_tank_ml"] - 0.5 * story.DOSE_ML
        assert after["garden_battery_ratio"] != before["garden_battery_ratio"]
        assert after["garden_body_late_seconds"] < 0.1
        assert after['garden_events_total{kind="task"}'] == 2
        answered = 'garden_mesh_requests_total{outcome="answered",peer="plant-1"}'
        assert after[answered] > before[answered]
        await garden.post("robot-1", "/stop", {})
        assert (await told("robot-1"))["garden_estop_latched"] == 1

        found: set[str] = set()
        for name in ("plant-1", "robot-1", "station", "sim"):
            found |= families(await metrics(name))
        assert found == listed() - ONLY_IN_PROCESSES - ONLY_WHERE_FLOODED

    story.tell(story.one_pot(), play)


def test_a_loop_that_was_held_up_tells_how_long() -> None:
    async def late() -> float:
        lag = LoopLag()
        running = asyncio.create_task(lag.run())
        loop = asyncio.get_running_loop()
        woken = loop.time()
        await asyncio.sleep(0)
        while loop.time() < woken + 0.7:
            pass  # holds the loop beyond the first wake-up
        await asyncio.sleep(0.01)
        running.cancel()
        return next(reading.value for reading in lag.readings())

    assert 0.1 < asyncio.run(late()) < 5.0
