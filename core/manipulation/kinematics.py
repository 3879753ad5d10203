"""The arm as transforms, for whoever works with arrays."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from core.manipulation.arm import Joints, hand_point

Array = NDArray[np.float64]


def forward(q: Joints) -> Array:
    """T_base_hand (4, 4): origin at the wrist axis, x along the hand, z up in the arm's plane [m]."""
    pan, pitch = q[0], q[1] + q[2] + q[3]
    cp, sp, ct, st = math.cos(pan), math.sin(pan), math.cos(pitch), math.sin(pitch)
    T = np.eye(4)
    T[:3, 0] = cp * ct, sp * ct, st
    T[:3, 1] = -sp, cp, 0.0
    T[:3, 2] = -cp * st, -sp * st, ct
    T[:3, 3] = hand_point(q, (0.0, 0.0, 0.0))
    return T


def map_points(T_a_b: Array, p_b: Array) -> Array:
    """Points (N, d) [m] in frame b -> the same points in frame a."""
    mapped: Array = p_b @ T_a_b[:-1, :-1].T + T_a_b[:-1, -1]
    return mapped
