"""A pinhole camera with a real lens: from points to pixels and back.

Camera frame: z forward through the picture, x right, y down (OpenCV's). Pixels count from the outer corner of the top left
one, so a pixel's centre lies at halves and a picture's middle at (width / 2, height / 2).
Lens: Brown and Conrady's model, as OpenCV has it (Brown 1966; k1, k2, k3 radial, p1, p2 tangential).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Distortion = tuple[float, float, float, float, float]
"""k1, k2, p1, p2, k3."""
NO_DISTORTION: Distortion = (0.0, 0.0, 0.0, 0.0, 0.0)
_UNDISTORT_ROUNDS = 25


@dataclass(frozen=True, slots=True, kw_only=True)
class Camera:
    """Intrinsics [px]."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: Distortion = NO_DISTORTION

    @property
    def fov_x_rad(self) -> float:
        """Across the whole width, as without distortion."""
        return math.atan(self.cx / self.fx) + math.atan((self.width - self.cx) / self.fx)

    @property
    def fov_y_rad(self) -> float:
        return math.atan(self.cy / self.fy) + math.atan((self.height - self.cy) / self.fy)

    def scaled(self, width: int, height: int) -> Camera:
        """The same view on another number of pixels."""
        sx, sy = width / self.width, height / self.height
        return replace(self, width=width, height=height, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy)


def from_fov(width: int, height: int, fov_y_rad: float, distortion: Distortion = NO_DISTORTION) -> Camera:
    """A camera with square pixels and its axis through the middle; the angle [rad] is as without distortion."""
    f = 0.5 * height / math.tan(fov_y_rad / 2)
    return Camera(width=width, height=height, fx=f, fy=f, cx=width / 2, cy=height / 2, distortion=distortion)


def look_at(eye: Array, target: Array, up: Array) -> Array:
    """T_world_cam (4, 4) of a camera at `eye` (3,) that looks at `target` (3,), `up` (3,) upwards in the picture."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    T_world_cam = np.eye(4)
    T_world_cam[:3, 0], T_world_cam[:3, 1], T_world_cam[:3, 2], T_world_cam[:3, 3] = x, np.cross(z, x), z, eye
    return T_world_cam


def project(camera: Camera, T_a_cam: Array, p_a: Array) -> Array:
    """Points (N, 3) [m] in frame a -> (N, 3): u, v [px] and depth along the axis [m]; not for depth <= 0."""
    p = (p_a - T_a_cam[:3, 3]) @ T_a_cam[:3, :3]
    depth = p[:, 2]
    bent = distort(camera.distortion, p[:, :2] / depth[:, None])
    return np.column_stack([camera.fx * bent[:, 0] + camera.cx, camera.fy * bent[:, 1] + camera.cy, depth])


def unproject(camera: Camera, uv_px: Array) -> Array:
    """Pixels (..., 2) -> points (..., 3) at depth 1 on their rays, camera frame."""
    bent = (uv_px - np.array([camera.cx, camera.cy])) / np.array([camera.fx, camera.fy])
    straight = undistort(camera.distortion, bent)
    return np.concatenate([straight, np.ones((*straight.shape[:-1], 1))], axis=-1)


def directions(camera: Camera) -> Array:
    """Unit rays (H, W, 3) through the pixels' centres, camera frame."""
    centres = np.empty((camera.height, camera.width, 2))
    centres[..., 0] = np.arange(camera.width)[None, :] + 0.5
    centres[..., 1] = np.arange(camera.height)[:, None] + 0.5
    rays = unproject(camera, centres)
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    return rays


def distort(distortion: Distortion, straight: Array) -> Array:
    """Where the lens puts points (..., 2) of the plane at depth 1."""
    if distortion == NO_DISTORTION:
        return straight
    k1, k2, p1, p2, k3 = distortion
    x, y = straight[..., 0], straight[..., 1]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=-1,
    )


def undistort(distortion: Distortion, bent: Array) -> Array:
    """The inverse of `distort`, by fixed-point steps: for lenses whose picture does not fold over itself."""
    straight = bent
    if distortion == NO_DISTORTION:
        return straight
    for _ in range(_UNDISTORT_ROUNDS):
        straight = straight + (bent - distort(distortion, straight))
    return straight


def sphere_outline(camera: Camera, p_cam: Array, radius_m: float) -> tuple[float, float, float]:
    """Centre (u, v) and radius [px] of the circle that is as large as a sphere's outline, distortion left out.

    p_cam (3,) [m], camera frame, the whole sphere before the camera. Source: a cone cut by a plane; at an angle t off the
    axis and a half opening a its semi-axes are sin a cos a / (cos^2 t - sin^2 a) and sin a / sqrt(cos^2 t - sin^2 a).
    """
    x, y, z = (float(value) for value in p_cam)
    sin2 = radius_m**2 / (x * x + y * y + z * z)
    cos2_off = z * z / (x * x + y * y + z * z)
    cut = cos2_off - sin2
    if z <= 0 or cut <= 0:
        raise ValueError("the sphere reaches behind the camera")
    long, short = math.sqrt(sin2 * (1 - sin2)) / cut, math.sqrt(sin2 / cut)
    # The ellipse's middle lies further out than the centre's image.
    out = z * z / (z * z - radius_m**2)
    u, v = camera.fx * out * x / z + camera.cx, camera.fy * out * y / z + camera.cy
    return u, v, math.sqrt(long * short * camera.fx * camera.fy)
