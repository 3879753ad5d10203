"""What a camera can see of a MuJoCo world: plain arrays, copied in one go so that a thread may draw them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from sim.scene.tomato import rgba_of

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]

_TO_OPENCV = np.diag([1.0, -1.0, -1.0])
"""MuJoCo's cameras look along -z with y up."""
VISIBLE_GROUPS = (0, 1, 2)
"""Geoms of other groups are collision hulls and helpers."""

PLAIN, ASTROTURF, SOIL, LEAF, LAMP, FRUIT, STEM, CLAY = range(8)
_TEXTURES = {
    "turf": ASTROTURF,
    "/soil": SOIL,
    "/leaf/": LEAF,
    "lamp-": LAMP,
    "/stub": STEM,
    "/fruit/": FRUIT,
    "/stem/": STEM,
    "/truss/": STEM,
    "/pot": CLAY,
}
"""The first word that a geom's or its material's name holds decides."""
_GLOSS = {FRUIT: 0.5, LEAF: 0.14, STEM: 0.06, CLAY: 0.03}
_RIPENESS = np.linspace(0.0, 1.0, 201)
SKIN_RGB: Floats = np.array([rgba_of(float(ripeness))[:3] for ripeness in _RIPENESS])
"""(201, 3): a fruit's colour from unripe to ripe, in equal steps."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Paint:
    """The look of every geom. Colours change as fruit ripen (`repaint`), the rest stays while the model lives."""

    rgba: Floats
    """(N, 4), 0-1."""
    texture: Ints
    """(N,), one of PLAIN ... CLAY."""
    gloss: Floats
    """(N,), strength of the highlight 0-1."""

    @property
    def ripeness(self) -> Floats:
        """(N,) 0-1: how ripe a fruit of this colour is; 0 for what is no fruit."""
        ripeness = np.zeros(len(self.texture))
        fruit = np.flatnonzero(self.texture == FRUIT)
        gap = np.abs(self.rgba[fruit, None, :3] - SKIN_RGB).sum(axis=2)
        ripeness[fruit] = _RIPENESS[gap.argmin(axis=1)] if len(fruit) else 0.0
        return ripeness


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
    leaf: npt.NDArray[np.bool_]
    """(N,): flat ellipsoids of which only a toothed leaf is drawn."""


def paint_of(model: Any) -> Paint:
    """The look of a model's geoms; the texture follows from a word in the material's or the geom's name."""
    gloss = np.full(model.ngeom, 0.15)
    texture = np.zeros(model.ngeom, dtype=np.int32)
    for geom in range(model.ngeom):
        material = int(model.geom_matid[geom])
        names = model.geom(geom).name
        if material >= 0:
            gloss[geom] = 0.5 * float(model.mat_specular[material])
            names += " " + model.mat(material).name
        texture[geom] = next((kind for word, kind in _TEXTURES.items() if word in names), PLAIN)
        gloss[geom] = _GLOSS.get(int(texture[geom]), gloss[geom])
    return Paint(rgba=_rgba(model), texture=texture, gloss=gloss)


def repaint(paint: Paint, model: Any) -> Paint:
    """The same look in the model's colours as they are now."""
    return replace(paint, rgba=_rgba(model))


def geoms_of(model: Any, data: Any, paint: Paint | None = None, groups: tuple[int, ...] = VISIBLE_GROUPS) -> Geoms:
    """A copy of the geoms as they stand now; transparent ones and other groups are invisible.

    Leaves have the shape of leaves if `paint` says which they are; without it they are MuJoCo's ellipsoids.
    """
    return Geoms(
        kind=np.array(model.geom_type, dtype=np.int32),
        size=np.array(model.geom_size, dtype=np.float64),
        pos=np.array(data.geom_xpos, dtype=np.float64),
        mat=np.array(data.geom_xmat, dtype=np.float64).reshape(-1, 9),
        visible=np.isin(model.geom_group, groups) & (_rgba(model)[:, 3] > 0.0),
        leaf=np.zeros(model.ngeom, dtype=np.bool_) if paint is None else paint.texture == LEAF,
    )


def seen_by_hand(model: Any, data: Any, robot_id: str, paint: Paint) -> tuple[Geoms, Floats]:
    """What is before a robot's hand camera now: the geoms, and T_world_cam (4, 4)."""
    geoms = geoms_of(model, data, paint)
    # The lens looks out of its own housing.
    geoms.visible[model.geom(f"{robot_id}/camera").id] = False
    eye = model.camera(f"{robot_id}/eye").id
    T_world_cam = np.eye(4)
    T_world_cam[:3, :3] = data.cam_xmat[eye].reshape(3, 3) @ _TO_OPENCV
    T_world_cam[:3, 3] = data.cam_xpos[eye]
    return geoms, T_world_cam


def _rgba(model: Any) -> Floats:
    rgba = np.array(model.geom_rgba, dtype=np.float64)
    painted = model.geom_matid >= 0
    rgba[painted] = model.mat_rgba[model.geom_matid[painted]]
    return rgba
