"""Trusses and fruit as MuJoCo bodies: each fruit swings free on a tendon that springs from its pedicel's joint.

A truss is a mocap body in the plant's frame, so that it can be pushed about with all that hangs on it. A place's fruit is a
free body that is there from the beginning, as a bud while nothing hangs there; `sim.physics.fruit` lets it grow.
Names: truss `PLANT/truss/K`; of a place, counted through the plant: body and ball `PLANT/fruit/N`, its stub of stalk
`PLANT/fruit/N/stub`, tendon and sites `PLANT/fruit/N/...`.
"""

from __future__ import annotations

import math
from typing import Any

import mujoco

from core.robots import gardener as g
from core.scenario import Plant
from sim.growth import RADIUS_MAX_M
from sim.physics.pose import Planar
from sim.scene.collide import A_FRUIT, NOTHING, SITE_GROUP, VISUAL_GROUP
from sim.scene.tomato import GREEN_RGBA, STEM_RGBA, Point, Shrub

CAPSULE, SPHERE = mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_SPHERE
STALK_NPM, STALK_DAMPING = 400.0, 0.4
BUD_M = 0.0015
SKIN_FRICTION = [0.6, 0.005, 0.0005]
"""Sliding, turning, rolling: no tomato is a perfect ball, so it comes to rest on a floor that leans by up to two degrees."""
SKIN_SOLREF, SKIN_SOLIMP = [-10000.0, -200.0], [0.99, 0.99, 0.001, 0.5, 2.0]
"""Of fruit against anything but rubber pads: stiffness and damping that swallow a fall (a tomato hardly bounces), and so
little give that friction does not creep: what lies in a basket lies still."""
GRIP_FRICTION = [1.0, 0.005, 0.0001]
GRIP_SOLREF, GRIP_SOLIMP = [0.005, 1.0], [0.95, 0.99, 0.001, 0.5, 2.0]
"""Of skin on rubber pads: stiff, or a grip of 6 N squeezes the fruit out of the hand."""


def fruit_name(plant_id: str, place: int) -> str:
    return f"{plant_id}/fruit/{place}"


def add_trusses(spec: Any, plant: Plant, shrub: Shrub) -> None:
    stem = Planar(plant.x_m, plant.y_m, math.radians(plant.dock_yaw_deg), g.SOIL_HEIGHT_M)
    number = 0
    for index, truss in enumerate(shrub.trusses):
        body = spec.worldbody.add_body(
            name=f"{plant.id}/truss/{index}", mocap=True, pos=[stem.x_m, stem.y_m, g.SOIL_HEIGHT_M],
            quat=[math.cos(stem.yaw_rad / 2), 0.0, 0.0, math.sin(stem.yaw_rad / 2)],
        )  # fmt: skip
        for nth, rod in enumerate(truss.rods):
            body.add_geom(name=f"{plant.id}/truss/{index}/{nth}", type=CAPSULE, size=[rod.radius_m, 0, 0],
                          fromto=[*rod.a, *rod.b], rgba=STEM_RGBA, group=VISUAL_GROUP, **NOTHING)  # fmt: skip
        for place in truss.places:
            name = fruit_name(plant.id, number)
            body.add_site(name=f"{name}/knuckle", pos=list(place.knuckle), group=SITE_GROUP)
            _add_bud(spec, name, _world(stem, place.knuckle), place.stalk_m)
            number += 1


def _add_bud(spec: Any, name: str, knuckle: Point, stalk_m: float) -> None:
    """Compiled at the size of the largest, so that MuJoCo's bounding volumes hold whatever grows of it."""
    fruit = spec.worldbody.add_body(name=name, pos=[knuckle[0], knuckle[1], knuckle[2] - stalk_m - BUD_M])
    fruit.add_freejoint(name=name)
    fruit.add_geom(name=name, type=SPHERE, size=[RADIUS_MAX_M, 0, 0], mass=0.012, rgba=(*GREEN_RGBA[:3], 0.0),
                   group=VISUAL_GROUP, condim=6, friction=SKIN_FRICTION, solref=SKIN_SOLREF, solimp=SKIN_SOLIMP, priority=1,
                   **A_FRUIT)  # fmt: skip
    fruit.add_geom(name=f"{name}/stub", type=CAPSULE, size=[0.0008, 0, 0], fromto=[0, 0, BUD_M, 0, 0, BUD_M + stalk_m],
                   mass=0.0, rgba=(*STEM_RGBA[:3], 0.0), group=VISUAL_GROUP, **NOTHING)  # fmt: skip
    fruit.add_site(name=f"{name}/top", pos=[0, 0, BUD_M], group=SITE_GROUP)
    stalk = spec.add_tendon(name=f"{name}/stalk", stiffness=STALK_NPM, damping=STALK_DAMPING, springlength=[0.0, stalk_m])
    stalk.wrap_site(f"{name}/knuckle")
    stalk.wrap_site(f"{name}/top")


def _world(stem: Planar, point: Point) -> Point:
    x_m, y_m = stem.point(point[0], point[1])
    return (x_m, y_m, point[2] + stem.z_m)
