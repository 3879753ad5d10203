"""Pictures of the running world: copied on the loop, drawn off it, not more often than is useful."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

import numpy as np

from core.clock import Clock
from core.errors import NotFound
from sim.camera.geoms import Geoms, Paint, geoms_of, paint_of, seen_by_hand
from sim.wiring import Rig

OVERVIEW_EVERY_S = 0.4
"""Wall seconds for which the last overview is good enough."""
OVERVIEW_COST_S = 0.4
HAND_COST_S = 0.15
HAND_SIZE = (640, 480)


class Pictures:
    """Draws with numba, imported in the drawing thread: a world that nobody looks at never pays for it."""

    def __init__(self, rig: Rig, clock: Clock) -> None:
        self._rig, self._clock = rig, clock
        self._paint: Paint = paint_of(rig.world.model)
        self._overview: asyncio.Task[bytes] | None = None
        self._overview_s = 0.0

    async def overview(self) -> bytes:
        """The garden from above as JPEG; askers at about the same time get the same picture."""
        now_s = asyncio.get_running_loop().time()
        if self._overview is None or (self._overview.done() and now_s - self._overview_s > OVERVIEW_EVERY_S):
            self._overview_s = now_s
            self._overview = asyncio.create_task(self._clock.offload(self._overview_job(), OVERVIEW_COST_S))
        return await asyncio.shield(self._overview)

    async def hand(self, robot_id: str, width: int, height: int) -> bytes:
        """What the camera in a robot's hand sees, as JPEG; raises NotFound."""
        if robot_id not in self._rig.world.robots:
            known = ", ".join(self._rig.world.robots)
            raise NotFound(f"no robot {robot_id}", hint=f"robots: {known}")
        return await self._clock.offload(self._hand_job(robot_id, width, height), HAND_COST_S)

    def _geoms(self) -> Geoms:
        self._rig.clockwork.catch_up()
        return geoms_of(self._rig.world.model, self._rig.world.data)

    def _overview_job(self) -> Callable[[], bytes]:
        geoms, paint, scenario = self._geoms(), self._paint, self._rig.world.scenario
        facts, caption = _facts(self._rig), _caption(self._rig)

        def job() -> bytes:
            from sim.camera import overview

            room = overview.Arena(**scenario.arena.model_dump(include={"length_m", "width_m", "ceiling_m"}))
            labels = [overview.Label(**fact) for fact in facts]
            return overview.jpeg(overview.draw(geoms, paint, room, labels, caption))

        return job

    def _hand_job(self, robot_id: str, width: int, height: int) -> Callable[[], bytes]:
        self._rig.clockwork.catch_up()
        model, data = self._rig.world.model, self._rig.world.data
        geoms, T_world_cam = seen_by_hand(model, data, robot_id)
        paint = self._paint
        lamps_m, lamps_rgb = np.array(data.light_xpos), np.array(model.light_diffuse, dtype=np.float64)

        def job() -> bytes:
            from sim.camera import hand, overview

            camera = hand.camera(width, height)
            light = hand.light_of(lamps_m, lamps_rgb)
            return overview.jpeg(hand.draw(camera, T_world_cam, geoms, paint, light))

        return job


def _facts(rig: Rig) -> list[dict[str, Any]]:
    """Arguments of the overview's labels."""
    world = rig.world
    facts: list[dict[str, Any]] = [
        {
            "p_world": (pot.plant.x_m, pot.plant.y_m, pot.plant.height_m + 0.32),
            "text": name,
            "ratio": pot.soil.moisture_ratio,
            "threshold_ratio": pot.plant.threshold_ratio,
        }
        for name, pot in world.pots.items()
    ]
    for name, robot in world.robots.items():
        facts.append({"p_world": (robot.pose.x_m, robot.pose.y_m, 0.5), "text": name})
    for dock in world.scenario.station.docks:
        facts.append({"p_world": (dock.x_m, dock.y_m, -0.12), "text": dock.id})
    return facts


def _caption(rig: Rig) -> str:
    world, clockwork = rig.world, rig.clockwork
    seconds = world.scenario.climate.start_hour * 3600 + world.time_s
    day, rest = divmod(int(seconds), 86400)
    pace = "paused" if clockwork.paused else f"{clockwork.rate:.1f} x"
    clock = f"{rest // 3600:02d}:{rest // 60 % 60:02d}:{rest % 60:02d}"
    return f"{world.scenario.name}   day {day + 1}  {clock}   {pace}   {'at rest' if world.at_rest else 'moving'}"
