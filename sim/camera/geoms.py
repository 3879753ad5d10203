"""What a camera can see of a MuJoCo world: plain arrays, copied in one go so that a thread may draw them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]

_TO_OPENCV = np.diag([1.0, -1.0, -1.0])
"""MuJoCo's cameras look along -z with y up."""
VISIBLE_GROUPS = (0, 1, 2)
"""Geoms of other groups are collision hulls and helpers."""

PLAIN, ASTROTURF, SOIL, LEAF, LAMP = range(5)
_TEXTURES = {"turf": ASTROTURF, "/soil": SOIL, "/leaf/": LEAF, "lamp-": LAMP}


@dataclass(frozen=True, slots=True, kw_only=True)
class Paint:
    """The look of every geom; does not change while the model lives."""

    rgba: Floats
    """(N, 4), linear 0-1."""
    texture: Ints
    """(N,), one of PLAIN, ASTROTURF, SOIL, LEAF, LAMP."""
    gloss: Floats
    """(N,), strength of the highlight 0-1."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Geoms:
    """The shapes and poses of all geoms at one instant; index = MuJoCo's geom id."""

    kind: Ints
    """(N,) mjtGeom."""
    size: Floats
    """(N, 3) [m]."""
    pos: Floats
    """(N, 3) [m], world."""
    mat: Floats
    """(N, 9), row-major R_world_geom."""
    visible: npt.NDArray[np.bool_]
    """(N,)."""


def paint_of(model: Any) -> Paint:
    """The look of a model's geoms; the texture follows from a word in the material's or the geom's name."""
    rgba = np.array(model.geom_rgba, dtype=np.float64)
    gloss = np.full(model.ngeom, 0.15)
    texture = np.zeros(model.ngeom, dtype=np.int32)
    for geom in range(model.ngeom):
        material = int(model.geom_matid[geom])
        names = model.geom(geom).name
        if material >= 0:
            rgba[geom] = model.mat_rgba[material]
            gloss[geom] = 0.5 * float(model.mat_specular[material])
            names += " " + model.mat(material).name
        texture[geom] = next((kind for word, kind in _TEXTURES.items() if word in names), PLAIN)
    return Paint(rgba=rgba, texture=texture, gloss=gloss)


def geoms_of(model: Any, data: Any, groups: tuple[int, ...] = VISIBLE_GROUPS) -> Geoms:
    """A copy of the geoms as they stand now; transparent ones and other groups are invisible."""
    alpha = np.where(model.geom_matid >= 0, _material_alpha(model), model.geom_rgba[:, 3])
    return Geoms(
        kind=np.array(model.geom_type, dtype=np.int32),
        size=np.array(model.geom_size, dtype=np.float64),
        pos=np.array(data.geom_xpos, dtype=np.float64),
        mat=np.array(data.geom_xmat, dtype=np.float64).reshape(-1, 9),
        visible=np.isin(model.geom_group, groups) & (alpha > 0.0),
    )


def seen_by_hand(model: Any, data: Any, robot_id: str) -> tuple[Geoms, Floats]:
    """What is before a robot's hand camera now: the geoms, and T_world_cam (4, 4)."""
    geoms = geoms_of(model, data)
    # The lens looks out of its own housing.
    geoms.visible[model.geom(f"{robot_id}/camera").id] = False
    eye = model.camera(f"{robot_id}/eye").id
    T_world_cam = np.eye(4)
    T_world_cam[:3, :3] = data.cam_xmat[eye].reshape(3, 3) @ _TO_OPENCV
    T_world_cam[:3, 3] = data.cam_xpos[eye]
    return geoms, T_world_cam


def _material_alpha(model: Any) -> Floats:
    if model.nmat == 0:
        return np.ones(model.ngeom)
    return np.asarray(model.mat_rgba[np.maximum(model.geom_matid, 0), 3], dtype=np.float64)
