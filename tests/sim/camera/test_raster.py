from __future__ import annotations

import math
from collections.abc import Iterator

import mujoco
import numpy as np
import pytest

from core.geometry.pinhole import Camera, directions, from_fov, look_at, project
from sim.camera.geoms import geoms_of
from sim.camera.raster import rasterise

KINDS = ("sphere", "ellipsoid", "capsule", "cylinder", "box")
UP = np.array([0.0, 0.0, 1.0])


def crowd(seed: int, count: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
    print(f"seed {seed}")
    rng = np.random.default_rng(seed)
    lines = ['<geom type="plane" size="3 2 .1"/>']
    for _ in range(count):
        kind = KINDS[rng.integers(len(KINDS))]
        size = " ".join(f"{s:.4f}" for s in rng.uniform(0.005, 0.15, 3))
        pos = " ".join(f"{p:.4f}" for p in rng.uniform((-1.5, -1.5, 0.0), (1.5, 1.5, 1.0)))
        quat = " ".join(f"{q:.4f}" for q in rng.normal(size=4))
        lines.append(f'<geom type="{kind}" size="{size}" pos="{pos}" quat="{quat}" group="{rng.integers(4)}"/>')
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{''.join(lines)}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def cast(model: mujoco.MjModel, data: mujoco.MjData, camera: Camera, T_world_cam: np.ndarray) -> tuple[np.ndarray, ...]:
    """MuJoCo's own answer: ids, distances and normals."""
    rays = np.ascontiguousarray(directions(camera).reshape(-1, 3) @ T_world_cam[:3, :3].T)
    ids = np.full(len(rays), -1, dtype=np.int32)
    distance_m, normal = np.zeros(len(rays)), np.zeros(rays.shape)
    groups = np.array([1, 1, 1, 0, 0, 0], dtype=np.uint8)
    eye = T_world_cam[:3, 3].copy()
    mujoco.mj_multiRay(
        model, data, eye, rays.ravel(), groups, 1, -1, ids, distance_m, normal.ravel(), len(rays), mujoco.mjMAXVAL
    )
    shape = (camera.height, camera.width)
    return ids.reshape(shape), distance_m.reshape(shape), normal.reshape(*shape, 3)


def poses() -> Iterator[np.ndarray]:
    yield look_at(np.array([2.5, 0.4, 1.2]), np.array([0.0, 0.0, 0.4]), UP)
    yield look_at(np.array([0.0, -0.5, 4.0]), np.array([0.0, 0.0, 0.0]), UP)
    yield look_at(np.array([0.1, 0.05, 0.45]), np.array([1.0, 1.0, 0.5]), UP)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("T_world_cam", list(poses()))
def test_the_raster_sees_what_mujocos_rays_see(seed: int, T_world_cam: np.ndarray) -> None:
    model, data = crowd(seed, 120)
    camera = from_fov(160, 120, math.radians(58.0))
    ours = rasterise(camera, T_world_cam, geoms_of(model, data))
    ids, distance_m, normal = cast(model, data, camera, T_world_cam)
    same = ours.ids == ids
    hit = same & (ids >= 0)
    assert same.mean() >= 0.999
    assert hit.mean() > 0.1
    assert np.abs(ours.distance_m - distance_m)[hit].max() < 1e-6
    assert np.abs(ours.normal - normal)[hit].max() < 1e-4


def test_a_camera_inside_a_shape_sees_its_far_wall() -> None:
    model, data = crowd(5, 0)
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><geom type="box" size="1 1 1"/><geom type="capsule" size=".2 .3" pos=".5 0 0"/>'
        "</worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    camera = from_fov(64, 48, math.radians(60.0))
    T_world_cam = look_at(np.array([0.55, 0.0, 0.1]), np.array([0.0, 0.3, 0.0]), UP)
    ours = rasterise(camera, T_world_cam, geoms_of(model, data))
    ids, distance_m, _ = cast(model, data, camera, T_world_cam)
    assert (ours.ids == ids).all()
    assert np.abs(ours.distance_m - distance_m).max() < 1e-6


def test_nothing_behind_the_camera_is_drawn() -> None:
    model, data = crowd(1, 60)
    camera = from_fov(32, 24, math.radians(50.0))
    away = look_at(np.array([5.0, 0.0, 1.0]), np.array([9.0, 0.0, 1.4]), UP)
    assert (rasterise(camera, away, geoms_of(model, data)).ids == -1).all()


def test_a_projected_point_lies_on_the_ray_of_its_pixel() -> None:
    camera = from_fov(64, 48, math.radians(50.0))
    T_world_cam = look_at(np.array([1.0, 2.0, 3.0]), np.zeros(3), UP)
    for v, u in ((0, 0), (47, 63), (20, 11)):
        p = T_world_cam[:3, 3] + 1.7 * T_world_cam[:3, :3] @ directions(camera)[v, u]
        assert project(camera, T_world_cam, p[None])[0, :2] == pytest.approx((u + 0.5, v + 0.5))


def test_a_scaled_camera_sees_the_same_corners() -> None:
    big = from_fov(640, 480, math.radians(50.0))
    small = big.scaled(320, 240)
    edge = (np.array([0.0, 640.0]) - big.cx) / big.fx
    assert (np.array([0.0, 320.0]) - small.cx) / small.fx == pytest.approx(edge)


def test_the_lens_bends_the_picture_and_its_rays_alike() -> None:
    """A distorted camera sees at each pixel what a ray through that pixel meets, up to the corners."""
    model, data = crowd(3, 120)
    camera = from_fov(160, 120, math.radians(58.0), (-0.28, 0.09, 0.002, -0.001, -0.01))
    for T_world_cam in poses():
        ours = rasterise(camera, T_world_cam, geoms_of(model, data))
        ids, _, _ = cast(model, data, camera, T_world_cam)
        assert (ours.ids == ids).mean() >= 0.999
