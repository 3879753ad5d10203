"""`garden bench camera`: a frame of the hand camera beside the same view by MuJoCo's rays, and by EGL where it is installed.

CPU milliseconds, ours and the peer's in turn. `mj_multiRay` with normals gives the same ids, distances and normals as our
raster; the whole frame (shadows, skins, lens, sensor) is held against those rays too, as their cost measures the machine.
EGL is MuJoCo's own renderer, with its shadows: a plainer picture.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import mujoco
import numpy as np

from core.geometry.pinhole import directions
from lab.vision.rendered import View, views
from sim.camera import hand
from sim.camera.egl import EglEye, chosen, instant_of
from sim.camera.raster import rasterise
from sim.world import World

SEED = 7
SIZES = ((320, 240), (640, 480))
RASTER_RATIO_MAX, FRAME_RATIO_MAX = 0.2, 0.5
"""Ours over MuJoCo's rays, which by themselves give no colour: 15 and 45 ms beside 95 (SIMULATION.md), and some to spare."""

Row = dict[str, Any]


def bench_camera(n: int = 5) -> list[Row]:
    """Rows `{name, ours, peer, ratio, unit, n, target, ok}` for both sizes; a peer that is not there has None."""
    return [row for size in SIZES for row in bench_size(size, n)]


def bench_size(size: tuple[int, int], n: int) -> list[Row]:
    """The raster, and the whole frame, of `n` views of a docked robot."""
    egl: EglEye | None = None
    raster: list[tuple[float, float]] = []
    frame: list[tuple[float, float | None]] = []
    for world, view in views(n, SEED, size):
        ours = partial(rasterise, view.camera, view.T_world_cam, view.geoms)
        whole = partial(hand.draw, view.camera, view.T_world_cam, view.geoms, view.paint, view.light, view.sensor)
        if chosen() and egl is None:
            egl = EglEye(world.model)
        name = f"{next(iter(world.robots))}/eye"
        theirs = None if egl is None else partial(egl.draw, instant_of(world.data), name, *size)
        for work in (whole, theirs):
            if work is not None:
                work()
        raster.append((_cpu_ms(ours), _cpu_ms(_rays(world, view))))
        frame.append((_cpu_ms(whole), None if theirs is None else _cpu_ms(theirs)))
    if egl is not None:
        egl.close()
    label = f"{size[0]}x{size[1]}"
    rays_ms = [theirs for _, theirs in raster]
    return [
        _row(f"raster_{label}", [ours for ours, _ in raster], rays_ms, RASTER_RATIO_MAX),
        _row(f"frame_{label}", [ours for ours, _ in frame], rays_ms, FRAME_RATIO_MAX),
        _row(f"frame_egl_{label}", [ours for ours, _ in frame], [theirs for _, theirs in frame if theirs is not None], None),
    ]


def _row(name: str, ours: list[float], peer: list[float], ratio_max: float | None) -> Row:
    mine, theirs = statistics.median(ours), statistics.median(peer) if peer else None
    ratio = None if theirs is None else mine / theirs
    row = {"name": f"camera.{name}", "ours": mine, "peer": theirs, "ratio": ratio, "unit": "CPU ms", "n": len(ours)}
    if ratio_max is None:
        return row | {"target": "none" if peer else "EGL is not installed or not chosen (MUJOCO_GL=egl)", "ok": None}
    return row | {"target": f"ratio <= {ratio_max:g}", "ok": ratio is not None and ratio <= ratio_max}


def _cpu_ms(work: Callable[[], object]) -> float:
    began_s = time.process_time()
    work()
    return 1e3 * (time.process_time() - began_s)


def _rays(world: World, view: View) -> Callable[[], None]:
    model, data = world.model, world.data
    eye = view.T_world_cam[:3, 3].copy()
    groups = np.array([1, 1, 1, 0, 0, 0], dtype=np.uint8)
    count = view.camera.width * view.camera.height
    ids, distance_m, normal = np.full(count, -1, dtype=np.int32), np.zeros(count), np.zeros(3 * count)
    rays = np.ascontiguousarray(directions(view.camera).reshape(-1, 3) @ view.T_world_cam[:3, :3].T).ravel()

    def cast() -> None:
        mujoco.mj_multiRay(model, data, eye, rays, groups, 1, -1, ids, distance_m, normal, count, mujoco.mjMAXVAL)

    return cast
