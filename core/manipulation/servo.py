"""Image-based visual servoing on one fruit: features (u, v, r), their interaction matrix, and what is known of the target.

Source: paper 000, section 6; Chaumette and Hutchinson 2006 for the matrix of a point. Camera frame: z forward, x right,
y down. The fruit is a ball of known radius, which is what makes its apparent radius r a measure of its distance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from core.errors import Unprocessable
from core.geometry.pinhole import Camera
from core.manipulation.kinematics import Array

FRUIT_RADIUS_M = 0.0135
"""The constant radius that the paper assumes: of a full-grown cherry tomato."""
GAIN = 0.7
STEP_M_MAX = 0.06
"""No single step of the servo is longer."""
PIXEL_SIGMA = 2.0
RADIUS_SIGMA_RATIO = 0.15
"""A fruit half hidden by a leaf looks smaller than it is."""
RADIUS_SIGMA_M, RADIUS_RANGE_M = 0.0015, (0.003, 0.025)
"""Fruit are not all of one size, nor is what the inventory has of them free of error; smaller and larger there are none."""
GATE_CHI2 = 11.3
"""Chi-square with 3 degrees of freedom, 99 %: neighbours hang two or three centimetres apart."""

KNOWN_SIGMA_M = 0.0055
"""Known this well, and seen `KNOWN_SIGHTINGS` times, a fruit may be taken though a leaf hides it at the end: the fingers
open wider by as much."""
KNOWN_SIGHTINGS = 2


def interaction_matrix(
    camera: Camera, u_px: float, v_px: float, radius_px: float, radius_m: float = FRUIT_RADIUS_M
) -> Array:
    """L (3, 3) [px/m]: how (u, v, r) change per metre that the camera moves along its x, y, z, the fruit staying.

    The distance follows from the fixed radius, Z = f R / r. Raises Unprocessable for r <= 0.
    """
    if radius_px <= 0.0:
        raise Unprocessable("a fruit of no size has no distance")
    z_m = camera.fx * radius_m / radius_px
    return np.array(
        [
            [-camera.fx / z_m, 0.0, (u_px - camera.cx) / z_m],
            [0.0, -camera.fy / z_m, (v_px - camera.cy) / z_m],
            [0.0, 0.0, radius_px / z_m],
        ]
    )


def calibrate(moves_m: Array, changes_px: Array) -> Array:
    """L (3, 3) by least squares from small moves of the camera (N, 3) [m] and what they did to the features (N, 3) [px].

    The paper's way: move before a target of known size. Raises Unprocessable unless the moves span all three directions.
    """
    if moves_m.shape != changes_px.shape or moves_m.ndim != 2 or moves_m.shape[1] != 3:
        raise Unprocessable("moves and changes must both be (N, 3)")
    if np.linalg.matrix_rank(moves_m, tol=1e-4) < 3:
        raise Unprocessable("the moves do not span all three directions", hint="move by a centimetre along x, y and z")
    transposed, *_ = np.linalg.lstsq(moves_m, changes_px, rcond=None)
    return np.asarray(transposed.T, dtype=np.float64)


def servo_step(L: Array, error_px: Array, gain: float = GAIN) -> Array:
    """How far the camera should move (3,) [m], in its own frame, against the error (u, v, r) - (u*, v*, r*) [px]."""
    step: Array = np.asarray(-gain * np.linalg.solve(L, error_px), dtype=np.float64)
    length_m = float(np.linalg.norm(step))
    return step if length_m <= STEP_M_MAX else step * (STEP_M_MAX / length_m)


@dataclass(slots=True)
class Target:
    """What is known of the fruit that is looked for: its centre (3,) in the base frame and its radius [m].

    `P` (4, 4) is their covariance, the radius last. Each sighting narrows it down (extended Kalman filter on (u, v, r));
    several from different places measure the distance far better than the radius alone.
    """

    p_base: Array
    P: Array
    radius_m: float = FRUIT_RADIUS_M
    sightings: int = 0

    @classmethod
    def expected(cls, p_base: Array, sigma_m: float, radius_m: float) -> Target:
        p = np.asarray(p_base, dtype=np.float64)
        return cls(p_base=p, P=np.diag([sigma_m**2] * 3 + [RADIUS_SIGMA_M**2]), radius_m=radius_m)

    def features(self, camera: Camera, T_base_cam: Array) -> Array:
        """(u, v, r) [px] where it should appear now; raises Unprocessable when it is behind the camera."""
        p = (self.p_base - T_base_cam[:3, 3]) @ T_base_cam[:3, :3]
        if p[2] <= 0.01:
            raise Unprocessable("the fruit is not before the camera")
        return np.array(
            [
                camera.fx * p[0] / p[2] + camera.cx,
                camera.fy * p[1] / p[2] + camera.cy,
                camera.fx * self.radius_m / p[2],
            ]
        )

    def _linear(self, camera: Camera, T_base_cam: Array) -> tuple[Array, Array]:
        """Expected features (3,) and H (3, 4): their change with the fruit's position and radius."""
        z = self.features(camera, T_base_cam)
        H = np.zeros((3, 4))
        H[:, :3] = -interaction_matrix(camera, z[0], z[1], z[2], self.radius_m) @ T_base_cam[:3, :3].T
        H[2, 3] = z[2] / self.radius_m
        return z, H

    def distance2(self, camera: Camera, T_base_cam: Array, seen: Array) -> float:
        """Squared Mahalanobis distance of a sighting (u, v, r) [px] from what is expected."""
        z, H = self._linear(camera, T_base_cam)
        gap = seen - z
        return float(gap @ np.linalg.solve(H @ self.P @ H.T + _noise(z), gap))

    def see(self, camera: Camera, T_base_cam: Array, seen: Array) -> None:
        """Take a sighting (u, v, r) [px] into account."""
        self.sightings += 1
        z, H = self._linear(camera, T_base_cam)
        K = self.P @ H.T @ np.linalg.inv(H @ self.P @ H.T + _noise(z))
        change = K @ (seen - z)
        self.p_base = self.p_base + change[:3]
        self.radius_m = float(np.clip(self.radius_m + change[3], *RADIUS_RANGE_M))
        left = np.eye(4) - K @ H
        self.P = left @ self.P @ left.T + K @ _noise(z) @ K.T

    @property
    def known(self) -> bool:
        """Whether pictures from several sides agree on its place."""
        return self.sightings >= KNOWN_SIGHTINGS and self.sigma_m <= KNOWN_SIGMA_M

    @property
    def sigma_m(self) -> float:
        """The largest standard deviation of its place in any direction [m]."""
        return float(np.sqrt(np.linalg.eigvalsh(self.P[:3, :3])[-1]))


def _noise(z: Array) -> Array:
    """Covariance (3, 3) of a sighting [px^2]; larger where the fruit is large in the picture."""
    side = PIXEL_SIGMA + 0.06 * z[2]
    noise: Array = np.diag([side**2, side**2, (1.0 + RADIUS_SIGMA_RATIO * z[2]) ** 2])
    return noise
