"""The hand's view by MuJoCo's own renderer, where somebody chose it with `MUJOCO_GL=egl` and the libraries are there.

A plainer picture than ours: no leaves but ellipsoids, no skins. A GL context belongs to the thread that made it, so all
drawing happens in one thread of its own.
"""

from __future__ import annotations

import importlib.util
import os
from concurrent.futures import ThreadPoolExecutor
from ctypes.util import find_library
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from sim.camera.geoms import Floats
from sim.camera.shade import GAMMA, Linear


def chosen() -> bool:
    """Asked for by `MUJOCO_GL=egl`, and installed."""
    wanted = os.environ.get("MUJOCO_GL", "").lower() == "egl"
    return wanted and find_library("EGL") is not None and importlib.util.find_spec("OpenGL") is not None


@dataclass(frozen=True, slots=True, kw_only=True)
class Instant:
    """The world's configuration at one instant, copied."""

    qpos: Floats
    mocap_pos: Floats
    mocap_quat: Floats


def instant_of(data: Any) -> Instant:
    """Of MuJoCo's data, on the thread that steps it."""
    return Instant(qpos=data.qpos.copy(), mocap_pos=data.mocap_pos.copy(), mocap_quat=data.mocap_quat.copy())


class EglEye:
    """Draws on EGL. `close` frees what it holds; without it the interpreter complains at its end."""

    def __init__(self, model: Any) -> None:
        self._model, self._data = model, mujoco.MjData(model)
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="egl")
        self._shown = mujoco.MjvOption()
        # Stalks are springs in the air; their stubs are geoms.
        self._shown.flags[mujoco.mjtVisFlag.mjVIS_TENDON] = False
        self._renderers: dict[tuple[int, int], Any] = {}

    def draw(self, instant: Instant, camera: str, width: int, height: int) -> Linear:
        """What a camera of the model sees, as light; waits for the drawing thread."""
        return self._thread.submit(self._draw, instant, camera, width, height).result()

    def close(self) -> None:
        self._thread.submit(self._close).result()
        self._thread.shutdown()

    def _draw(self, instant: Instant, camera: str, width: int, height: int) -> Linear:
        if (width, height) not in self._renderers:
            self._close()
            self._renderers[width, height] = mujoco.Renderer(self._model, height, width)
        renderer = self._renderers[width, height]
        self._data.qpos[:] = instant.qpos
        self._data.mocap_pos[:], self._data.mocap_quat[:] = instant.mocap_pos, instant.mocap_quat
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        renderer.update_scene(self._data, camera=camera, scene_option=self._shown)
        film: Linear = ((renderer.render().astype(np.float32) / 255.0) ** GAMMA).astype(np.float32)
        return film

    def _close(self) -> None:
        for renderer in self._renderers.values():
            renderer.close()
        self._renderers.clear()
