"""Pictures of the running world: copied on the loop, drawn off it, not more often than is useful."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from core.clock import Clock
from core.errors import NotFound, Unavailable
from sim.body import RobotBody
from sim.camera.geoms import Floats, Geoms, Paint, geoms_of, paint_of, repaint, seen_by_hand
from sim.wiring import Rig

OVERVIEW_EVERY_S = 0.4
"""Wall seconds for which the last overview is good enough."""
OVERVIEW_COST_S = 0.4
HAND_SIZE = (640, 480)
HAND_COST_S, DEPTH_COST_S = 0.20, 0.05
"""At that size; a picture's cost goes with its pixels."""


class Pictures:
    """Draws with numba, imported before a world's robots look, else in the drawing thread: who never looks never pays."""

    def __init__(self, rig: Rig, clock: Clock) -> None:
        self._rig, self._clock = rig, clock
        self._paint: Paint = paint_of(rig.world.model)
        self._overview: asyncio.Task[bytes] | None = None
        self._overview_s = 0.0
        self._last: dict[tuple[str, int, int], bytes] = {}
        """The hands' last pictures, by robot and size: what a frozen camera repeats."""
        self._taken = 0
        self._egl: Any = None

    async def overview(self) -> bytes:
        """The garden from above as JPEG; askers at about the same time get the same picture."""
        now_s = asyncio.get_running_loop().time()
        if self._overview is None or (self._overview.done() and now_s - self._overview_s > OVERVIEW_EVERY_S):
            self._overview_s = now_s
            self._overview = asyncio.create_task(self._clock.offload(self._overview_job(), OVERVIEW_COST_S))
        return await asyncio.shield(self._overview)

    async def hand(self, robot_id: str, width: int, height: int) -> bytes:
        """What the camera in a robot's hand gives, as JPEG; raises NotFound, Unavailable when the camera is silent."""
        faults = self._robot(robot_id).faults
        if "camera_silent" in faults.camera:
            raise Unavailable(f"the camera of {robot_id} is silent")
        kept = self._last.get((robot_id, width, height))
        if kept is None or "camera_frozen" not in faults.camera:
            job = self._hand_job(robot_id, width, height)
            kept = await self._clock.offload(job, HAND_COST_S * width * height / (HAND_SIZE[0] * HAND_SIZE[1]))
            self._last[robot_id, width, height] = kept
        return kept

    async def depth(self, robot_id: str, width: int, height: int) -> bytes:
        """The hand's view as depth along its axis: a PNG of 16-bit millimetres, 0 where nothing is; raises NotFound."""
        self._robot(robot_id)
        return await self._clock.offload(self._depth_job(robot_id, width, height), DEPTH_COST_S)

    def _robot(self, robot_id: str) -> RobotBody:
        """Raises NotFound."""
        if (robot := self._rig.world.robots.get(robot_id)) is None:
            known = ", ".join(self._rig.world.robots)
            raise NotFound(f"no robot {robot_id}", hint=f"robots: {known}")
        return robot

    def _geoms(self) -> Geoms:
        self._rig.clockwork.catch_up()
        return geoms_of(self._rig.world.model, self._rig.world.data, self._paint)

    def _overview_job(self) -> Callable[[], bytes]:
        geoms, scenario = self._geoms(), self._rig.world.scenario
        paint = repaint(self._paint, self._rig.world.model)
        facts, caption = _facts(self._rig), _caption(self._rig)

        def job() -> bytes:
            from sim.camera import overview

            room = overview.Arena(**scenario.arena.model_dump(include={"length_m", "width_m", "ceiling_m"}))
            labels = [overview.Label(**fact) for fact in facts]
            return overview.jpeg(overview.draw(geoms, paint, room, labels, caption))

        return job

    def _hand_job(self, robot_id: str, width: int, height: int) -> Callable[[], bytes]:
        geoms, T_world_cam = self._seen(robot_id)
        paint, faults = repaint(self._paint, self._rig.world.model), self._robot(robot_id).faults
        broken, overexposure = faults.camera, faults.overexposure
        plain = self._egl_film(robot_id, width, height)
        lamps_m, tint = np.array(self._rig.world.data.light_xpos), self._rig.world.scenario.arena.lamps
        self._taken += 1
        seed = self._taken

        def job() -> bytes:
            from sim.camera import hand, overview

            camera, sensor = hand.camera(width, height), hand.Sensor(exposure=overexposure)
            light = hand.light_of(lamps_m, hand.LAMP_RGB[tint], hand.nearest_lamp(lamps_m, T_world_cam))
            if "camera_black" in broken:
                return overview.jpeg(hand.covered(camera, sensor, seed))
            if plain is None:
                picture = hand.draw(camera, T_world_cam, geoms, paint, light, sensor, seed)
            else:
                picture = hand.develop(plain(), np.full((height, width), sensor.focus_m), light, sensor, seed)
            if "camera_upside_down" in broken:
                picture = np.ascontiguousarray(picture[::-1, ::-1])
            return overview.jpeg(picture)

        return job

    def _egl_film(self, robot_id: str, width: int, height: int) -> Callable[[], npt.NDArray[np.float32]] | None:
        """How MuJoCo's own renderer would draw this instant, if it was chosen."""
        if os.environ.get("MUJOCO_GL", "").lower() != "egl":
            return None
        from sim.camera import egl

        if not egl.chosen():
            return None
        if self._egl is None:
            self._egl = egl.EglEye(self._rig.world.model)
        return partial(self._egl.draw, egl.instant_of(self._rig.world.data), f"{robot_id}/eye", width, height)

    def _depth_job(self, robot_id: str, width: int, height: int) -> Callable[[], bytes]:
        geoms, T_world_cam = self._seen(robot_id)

        def job() -> bytes:
            from sim.camera import hand

            return hand.depth_png(hand.camera(width, height), T_world_cam, geoms)

        return job

    def _seen(self, robot_id: str) -> tuple[Geoms, Floats]:
        self._rig.clockwork.catch_up()
        return seen_by_hand(self._rig.world.model, self._rig.world.data, robot_id, self._paint)


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
