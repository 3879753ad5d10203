from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from core.geometry.pinhole import NO_DISTORTION, Camera, directions, from_fov, look_at, project, sphere_outline, unproject

LENS = (-0.31, 0.12, 0.0015, -0.0008, -0.02)
UP = np.array([0.0, 0.0, 1.0])


def camera(distortion: tuple[float, float, float, float, float] = LENS) -> Camera:
    return from_fov(640, 480, math.radians(48.0), distortion)


def cloud(count: int) -> np.ndarray:
    rng = np.random.default_rng(5)
    return np.column_stack([rng.uniform(-0.2, 0.2, (count, 2)), rng.uniform(0.4, 2.0, count)])


@pytest.mark.parametrize("lens", [NO_DISTORTION, LENS])
def test_points_fall_where_opencv_puts_them(lens: tuple[float, float, float, float, float]) -> None:
    """OpenCV counts from the middle of the first pixel, we from its corner."""
    eye, points = camera(lens), cloud(200)
    K = np.array([[eye.fx, 0, eye.cx - 0.5], [0, eye.fy, eye.cy - 0.5], [0, 0, 1]])
    theirs, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array(lens))
    assert project(eye, np.eye(4), points)[:, :2] == pytest.approx(theirs[:, 0] + 0.5, abs=1e-6)


@pytest.mark.parametrize("lens", [NO_DISTORTION, LENS])
def test_to_the_picture_and_back_is_the_same_ray(lens: tuple[float, float, float, float, float]) -> None:
    points = cloud(200)
    back = unproject(camera(lens), project(camera(lens), np.eye(4), points)[:, :2])
    assert back == pytest.approx(points / points[:, 2:], abs=1e-5)


def test_rays_pass_through_the_middles_of_pixels() -> None:
    T_world_cam = look_at(np.array([1.0, 2.0, 3.0]), np.zeros(3), UP)
    rays = directions(camera().scaled(64, 48))
    for v, u in ((0, 0), (47, 63), (20, 11)):
        p = T_world_cam[:3, 3] + 1.7 * T_world_cam[:3, :3] @ rays[v, u]
        assert project(camera().scaled(64, 48), T_world_cam, p[None])[0, :2] == pytest.approx((u + 0.5, v + 0.5), abs=1e-3)


def test_half_the_pixels_see_the_same_angles() -> None:
    small = camera().scaled(320, 240)
    assert small.fov_x_rad == pytest.approx(camera().fov_x_rad)
    assert small.fov_y_rad == pytest.approx(math.radians(48.0))


def test_a_spheres_outline_covers_what_its_rays_cover() -> None:
    eye, p, radius_m = camera(NO_DISTORTION), np.array([0.09, -0.06, 0.30]), 0.02
    rays = directions(eye)
    across = np.linalg.norm(np.cross(rays, p), axis=2)
    v, u = np.nonzero(across < radius_m)
    outline = sphere_outline(eye, p, radius_m)
    assert outline[:2] == pytest.approx((u.mean() + 0.5, v.mean() + 0.5), abs=0.05)
    assert math.pi * outline[2] ** 2 == pytest.approx(len(u), rel=0.01)


def test_a_sphere_about_the_camera_has_no_outline() -> None:
    with pytest.raises(ValueError, match="behind"):
        sphere_outline(camera(), np.array([0.0, 0.0, 0.01]), 0.02)
