"""A pinhole camera: intrinsics, pose, rays.

Camera frame: z forward through the picture, x right, y down (OpenCV's).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sim.camera.geoms import Floats


@dataclass(frozen=True, slots=True, kw_only=True)
class Camera:
    """Intrinsics in pixels; pixel (u, v) has its centre at whole numbers."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def scaled(self, width: int, height: int) -> Camera:
        """The same view on another number of pixels."""
        sx, sy = width / self.width, height / self.height
        return Camera(
            width=width,
            height=height,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=(self.cx + 0.5) * sx - 0.5,
            cy=(self.cy + 0.5) * sy - 0.5,
        )


def from_fov(width: int, height: int, fov_y_deg: float) -> Camera:
    """A camera with square pixels and its axis through the middle."""
    f = 0.5 * height / math.tan(math.radians(fov_y_deg) / 2)
    return Camera(width=width, height=height, fx=f, fy=f, cx=(width - 1) / 2, cy=(height - 1) / 2)


def look_at(eye: Floats, target: Floats, up: Floats) -> Floats:
    """T_world_cam (4, 4) of a camera at `eye` (3,) that looks at `target` (3,), `up` (3,) upwards in the picture."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    T_world_cam = np.eye(4)
    T_world_cam[:3, 0], T_world_cam[:3, 1], T_world_cam[:3, 2], T_world_cam[:3, 3] = x, np.cross(z, x), z, eye
    return T_world_cam


def project(camera: Camera, T_world_cam: Floats, p_world: Floats) -> Floats:
    """Points (N, 3) [m] in the world -> (N, 3): u, v [px] and depth along the axis [m]; not for depth <= 0."""
    p = (p_world - T_world_cam[:3, 3]) @ T_world_cam[:3, :3]
    depth = p[:, 2]
    return np.stack([camera.fx * p[:, 0] / depth + camera.cx, camera.fy * p[:, 1] / depth + camera.cy, depth], axis=1)


def directions(camera: Camera) -> Floats:
    """Unit rays (H, W, 3) in the camera frame."""
    u = (np.arange(camera.width) - camera.cx) / camera.fx
    v = (np.arange(camera.height) - camera.cy) / camera.fy
    rays = np.ones((camera.height, camera.width, 3))
    rays[..., 0], rays[..., 1] = u[None, :], v[:, None]
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    return rays
