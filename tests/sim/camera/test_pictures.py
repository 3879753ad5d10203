from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest

from core.geometry.pinhole import Camera, directions, from_fov, look_at, project
from core.scenario import find
from sim.camera import hand, overview
from sim.camera.geoms import ASTROTURF, FRUIT, LEAF, SOIL, Floats, Geoms, Paint, geoms_of, paint_of
from sim.camera.raster import rasterise
from sim.camera.shade import Lamp, Light, cast_shadow, shade
from sim.scene.build import build
from sim.scene.tomato import rgba_of

UP = np.array([0.0, 0.0, 1.0])
BALL_OVER_FLOOR = """<mujoco><worldbody>
  <geom name="floor" type="plane" size="3 3 .1" rgba=".5 .5 .5 1"/>
  <geom name="ball" type="sphere" size=".2" pos="0 0 .6" rgba=".9 .1 .1 1"/>
</worldbody></mujoco>"""


@pytest.fixture(scope="module")
def garden() -> tuple[mujoco.MjModel, mujoco.MjData]:
    scene = build(find("garden"), 7)
    data = mujoco.MjData(scene.model)
    mujoco.mj_forward(scene.model, data)
    return scene.model, data


def seen(xml: str) -> tuple[Geoms, Paint]:
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return geoms_of(model, data), paint_of(model)


def test_the_whole_garden_is_seen_as_mujocos_rays_see_it(garden: tuple[mujoco.MjModel, mujoco.MjData]) -> None:
    """One ray at a time: `mj_multiRay` culls by angle and misses leaves here that `mj_ray` hits."""
    model, data = garden
    camera = from_fov(80, 60, math.radians(60.0))
    T_world_cam = look_at(np.array([-1.2, 0.9, 0.5]), np.array([-0.5, 0.75, 0.55]), UP)
    ours = rasterise(camera, T_world_cam, geoms_of(model, data))
    groups, found = np.array([1, 1, 1, 0, 0, 0], dtype=np.uint8), np.zeros(1, dtype=np.int32)
    eye, same, ids = T_world_cam[:3, 3].copy(), 0, set()
    rays = directions(camera) @ T_world_cam[:3, :3].T
    for v, u in np.ndindex(60, 80):
        distance_m = mujoco.mj_ray(model, data, eye, rays[v, u], groups, 1, -1, found, None)
        ids.add(int(found[0]))
        if found[0] == ours.ids[v, u]:
            same += 1
            assert found[0] < 0 or abs(distance_m - ours.distance_m[v, u]) < 1e-6
    assert same >= 0.999 * 60 * 80
    assert len(ids) > 30


def test_textures_follow_from_names(garden: tuple[mujoco.MjModel, mujoco.MjData]) -> None:
    model, _ = garden
    texture = paint_of(model).texture
    assert texture[model.geom("floor-slab").id] == ASTROTURF
    assert texture[model.geom("plant-1/soil").id] == SOIL
    assert (texture == LEAF).sum() > 50
    assert (texture == FRUIT).sum() >= sum(plant.fruit for plant in find("garden").plants)


def test_a_leaf_is_a_part_of_its_ellipsoid_and_the_rest_stays_as_it_was(
    garden: tuple[mujoco.MjModel, mujoco.MjData],
) -> None:
    model, data = garden
    paint = paint_of(model)
    camera = from_fov(160, 120, math.radians(60.0))
    T_world_cam = look_at(np.array([-1.2, 0.9, 0.5]), np.array([-0.5, 0.75, 0.55]), UP)
    whole, cut = (rasterise(camera, T_world_cam, geoms_of(model, data, p)) for p in (None, paint))
    leaf = np.append(paint.texture == LEAF, False)
    assert (whole.ids == cut.ids)[~leaf[whole.ids]].all()
    assert 0.4 < leaf[cut.ids].sum() / leaf[whole.ids].sum() < 0.9


@pytest.mark.parametrize("ripeness", [0.1, 0.5, 0.6, 0.7, 0.9])
def test_how_ripe_a_fruit_is_can_be_told_from_its_colour(ripeness: float) -> None:
    paint = Paint(rgba=np.array([rgba_of(ripeness)]), texture=np.array([FRUIT], dtype=np.int32), gloss=np.zeros(1))
    assert rgba_of(float(paint.ripeness[0])) == pytest.approx(rgba_of(ripeness), abs=0.02)


@pytest.mark.parametrize(("length_m", "width_m"), [(4.0, 3.0), (1.5, 1.5), (20.0, 3.0), (3.0, 20.0)])
def test_the_overview_holds_any_arena_in_its_frame_and_wastes_little(length_m: float, width_m: float) -> None:
    camera, T_world_cam = overview.view_of(overview.Arena(length_m=length_m, width_m=width_m, ceiling_m=2.6))
    corners = np.array([(sx * length_m / 2, sy * width_m / 2, 0.0) for sx in (-1, 1) for sy in (-1, 1)])
    p = project(camera, T_world_cam, corners)
    assert (p[:, 0] > 0).all()
    assert (p[:, 0] < overview.WIDTH).all()
    assert (p[:, 1] > 0).all()
    assert (p[:, 1] < overview.HEIGHT).all()
    assert max(np.ptp(p[:, 0]) / overview.WIDTH, np.ptp(p[:, 1]) / overview.HEIGHT) > 0.5


def test_a_ball_casts_a_shadow_away_from_the_lamp() -> None:
    geoms, paint = seen(BALL_OVER_FLOOR)
    lamp = Lamp(pos_m=(-4.0, 0.0, 6.0), rgb=(0.8, 0.8, 0.8))
    light = Light(lamps=(lamp,))
    camera, T_world_cam = from_fov(200, 200, math.radians(60.0)), look_at(np.array([0.0, -0.01, 3.5]), np.zeros(3), UP)
    raster = rasterise(camera, T_world_cam, geoms)
    shadow = cast_shadow(lamp, geoms, (0.0, 0.0, 0.0), 2.0)
    lit, shaded = (shade(camera, T_world_cam, raster, geoms, paint, light, s) for s in (None, shadow))
    darker = (lit.astype(int) - shaded).max(axis=2) > 30
    assert 0.005 < darker.mean() < 0.05
    middle = np.argwhere(darker & (raster.ids == 0)).mean(axis=0)
    expected = project(camera, T_world_cam, np.array([[0.42, 0.0, 0.0]]))[0, 1::-1]
    assert middle == pytest.approx(expected, abs=6)


def view_of_the_ball() -> tuple[Camera, Floats]:
    return hand.camera(64, 48), look_at(np.array([1.5, 0.0, 0.8]), np.array([0.0, 0.0, 0.6]), UP)


def test_a_darker_exposure_darkens_and_a_red_ball_stays_red() -> None:
    geoms, paint = seen(BALL_OVER_FLOOR)
    light = hand.light_of(np.array([[1.0, -1.0, 3.0]]))
    camera, T_world_cam = view_of_the_ball()
    ball = rasterise(camera, T_world_cam, geoms).ids == 1
    bright, dark = (
        hand.draw(camera, T_world_cam, geoms, paint, light, hand.Sensor(exposure=e))[ball].mean(axis=0) for e in (1.0, 0.4)
    )
    assert (dark < bright).all()
    assert bright[2] > 2 * max(bright[0], bright[1])


def test_white_balance_takes_the_tint_of_grow_lamps_out_of_a_grey_floor() -> None:
    geoms, paint = seen(BALL_OVER_FLOOR)
    light = hand.light_of(np.array([[1.0, -1.0, 3.0]]), hand.LAMP_RGB["purple"])
    camera, T_world_cam = view_of_the_ball()
    floor = rasterise(camera, T_world_cam, geoms).ids == 0
    tints = []
    for strength in (0.0, 1.0):
        blue, green, red = hand.draw(camera, T_world_cam, geoms, paint, light, hand.Sensor(white_balance=strength))[
            floor
        ].mean(axis=0)
        tints.append(max(blue, red) / green)
    assert tints[0] > 1.5
    assert tints[1] < 1.15


def test_noise_is_a_function_of_its_seed() -> None:
    geoms, paint = seen(BALL_OVER_FLOOR)
    light = hand.light_of(np.array([[1.0, -1.0, 3.0]]))
    first, again, other = (hand.draw(*view_of_the_ball(), geoms, paint, light, seed=s) for s in (1, 1, 2))
    assert (first == again).all()
    assert 0 < np.abs(first.astype(int) - other).mean() < 12


def test_the_same_scene_gives_the_same_picture() -> None:
    geoms, paint = seen(BALL_OVER_FLOOR)
    room = overview.Arena(length_m=4.0, width_m=3.0, ceiling_m=2.6)
    labels = [overview.Label(p_world=(0.0, 0.0, 1.0), text="plant-1", ratio=0.2, threshold_ratio=0.25)]
    first, second = (overview.draw(geoms, paint, room, labels, "x") for _ in range(2))
    assert (first == second).all()
    assert (first != overview.draw(geoms, paint, room, [], "x")).any()
