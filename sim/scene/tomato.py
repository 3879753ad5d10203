"""Procedural cherry tomato shrubs: a winding stem, compound leaves, and trusses with places for fruit.

A truss is an axis of some 17 cm with fruit left and right of it, 20 to 26 mm of axis from one to the next; full-grown fruit
is 23 to 32 mm across and weighs 12 g, as measured on cherry clusters (axis 170.5 mm, 3.3 mm thick at its root and 1.9 mm at
its tip; fruit 30.5 mm, 11.7 g: design study of a cluster end effector, airobotsight.com/?p=3708). The pedicel's far part,
from the joint (knuckle) where it breaks to the fruit, is 8 to 11 mm.
Trusses leave the stem some 20 cm apart, three leaves between them.
What hangs there, how big and how ripe it is: `sim.growth`. How it hangs and breaks: `sim.physics.fruit`.
Plant frame: origin at the soil's centre, z up; x towards the dock.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import numpy.typing as npt

Colour = Literal["green", "turning", "red"]
Point = tuple[float, float, float]
Rgba = tuple[float, float, float, float]

STEM_RGBA: Rgba = (0.30, 0.45, 0.16, 1.0)
LEAF_RGBA: Rgba = (0.16, 0.42, 0.12, 1.0)
GREEN_RGBA: Rgba = (0.38, 0.60, 0.20, 1.0)
TURNING_RGBA: Rgba = (0.90, 0.48, 0.10, 1.0)
RED_RGBA: Rgba = (0.85, 0.07, 0.04, 1.0)
TURNING_FROM, RED_FROM = 0.45, 0.75
"""Ripeness 0 (just set) .. 1 (ready to drop) at which a fruit counts as turning, as red."""
DOCK_SIDE_RAD = math.radians(75.0)
"""Trusses are trained to the side that the robots can reach."""
LEAVES_PER_METRE = 22
TRUSS_FRUIT = 6
"""On a truss of the length that was measured."""
FIRST_TRUSS_M, TRUSS_APART_M, TOP_TRUSS_SHARE = 0.21, 0.20, 0.72
"""Height of the lowest truss's root above the soil, of each further one above it; the topmost at this share of the plant."""
PEDUNCLE_M = 0.055
"""From the stem to the first fruit's pedicel."""
AXIS_RADIUS_M = (0.00165, 0.00095)
"""At the root, at the tip."""
PEDICEL_RADIUS_M = 0.001


@dataclass(frozen=True, slots=True, kw_only=True)
class Rod:
    """A capsule from a to b [m], plant frame."""

    a: Point
    b: Point
    radius_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Leaflet:
    """A flat ellipsoid: centre and half axes [m], orientation q_plant_leaf (w, x, y, z)."""

    centre: Point
    half_m: Point
    q_wxyz: tuple[float, float, float, float]
    rgba: Rgba


@dataclass(frozen=True, slots=True, kw_only=True)
class Place:
    """Where a fruit hangs, or may come to hang."""

    knuckle: Point
    """The joint of its pedicel [m], plant frame: above it the plant is firm, below it the fruit swings."""
    stalk_m: float
    """Length of the pedicel from the joint to the fruit."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Truss:
    """One axis with its places, from the stem outwards; `flowering` ones bear nothing yet."""

    rods: tuple[Rod, ...]
    places: tuple[Place, ...]
    flowering: bool


@dataclass(slots=True)
class Shrub:
    rods: list[Rod] = field(default_factory=list)
    leaves: list[Leaflet] = field(default_factory=list)
    trusses: list[Truss] = field(default_factory=list)
    """From below upwards, which is from old to young."""


def colour_of(ripeness: float) -> Colour:
    return "red" if ripeness >= RED_FROM else "turning" if ripeness >= TURNING_FROM else "green"


def rgba_of(ripeness: float) -> Rgba:
    """The skin's colour, continuous in ripeness."""
    marks = [(0.0, GREEN_RGBA), (TURNING_FROM, GREEN_RGBA), (0.62, TURNING_RGBA), (RED_FROM, RED_RGBA), (1.0, RED_RGBA)]
    at = [m for m, _ in marks]
    r, g, b, a = (float(np.interp(ripeness, at, [rgba[i] for _, rgba in marks])) for i in range(4))
    return (r, g, b, a)


def grow(height_m: float, fruit: int, rng: np.random.Generator) -> Shrub:
    """A shrub `height_m` tall with places for `fruit` fruit and, where there is room, a truss in flower; all by `rng`."""
    shrub = Shrub()
    spine = _stem(shrub, height_m, rng)
    _leaves(shrub, spine, height_m, rng)
    _trusses(shrub, spine, fruit, height_m, rng)
    return shrub


def _stem(shrub: Shrub, height_m: float, rng: np.random.Generator) -> npt.NDArray[np.float64]:
    count = 8
    spine = np.zeros((count + 1, 3))
    for index in range(1, count + 1):
        sway = rng.normal(0.0, 0.010, 2)
        spine[index] = (*(0.85 * spine[index - 1, :2] + sway), height_m * index / count)
    for index in range(count):
        radius_m = 0.007 - 0.004 * index / count
        shrub.rods.append(Rod(a=_point(spine[index]), b=_point(spine[index + 1]), radius_m=radius_m))
    return spine


def _along(spine: npt.NDArray[np.float64], z_m: float) -> npt.NDArray[np.float64]:
    return np.array([np.interp(z_m, spine[:, 2], spine[:, axis]) for axis in range(3)])


def _leaves(shrub: Shrub, spine: npt.NDArray[np.float64], height_m: float, rng: np.random.Generator) -> None:
    """Compound leaves spiral up the stem by the golden angle: a petiole, a pair of leaflets on it and one at its end."""
    count = max(4, round(LEAVES_PER_METRE * height_m))
    for index in range(count):
        share = (index + 0.5) / count
        root = _along(spine, height_m * (0.12 + 0.88 * share))
        azimuth = index * math.radians(137.5) + rng.normal(0.0, 0.2)
        length_m = (0.10 + 0.09 * math.sin(math.pi * share)) * rng.uniform(0.8, 1.15)
        rise = rng.uniform(0.05, 0.45)
        out = np.array([math.cos(azimuth), math.sin(azimuth), rise])
        tip = root + length_m * out / np.linalg.norm(out)
        shrub.rods.append(Rod(a=_point(root), b=_point(tip), radius_m=0.002))
        for at, side in ((1.05, 0.0), (0.62, 0.9), (0.62, -0.9)):
            shrub.leaves.append(_leaflet(root + at * (tip - root), azimuth + side, length_m, rng))


def _leaflet(root: npt.NDArray[np.float64], azimuth: float, petiole_m: float, rng: np.random.Generator) -> Leaflet:
    half_long = 0.28 * petiole_m * rng.uniform(0.8, 1.2)
    droop = rng.uniform(0.1, 0.6)
    reach = np.array([math.cos(azimuth) * math.cos(droop), math.sin(azimuth) * math.cos(droop), -math.sin(droop)])
    shade = rng.uniform(0.8, 1.2)
    return Leaflet(
        centre=_point(root + half_long * reach),
        half_m=(half_long, 0.55 * half_long, 0.0015),
        q_wxyz=_yaw_pitch_roll(azimuth, droop, rng.normal(0.0, 0.25)),
        rgba=(LEAF_RGBA[0] * shade, LEAF_RGBA[1] * shade, LEAF_RGBA[2] * shade, 1.0),
    )


def _trusses(shrub: Shrub, spine: npt.NDArray[np.float64], fruit: int, height_m: float, rng: np.random.Generator) -> None:
    if fruit == 0:
        return
    room = 1 + max(0, math.floor((TOP_TRUSS_SHARE * height_m - FIRST_TRUSS_M) / TRUSS_APART_M))
    bearing = min(room, math.ceil(fruit / TRUSS_FRUIT))
    sizes = [fruit // bearing + (index < fruit % bearing) for index in range(bearing)]
    if bearing < room:
        sizes.append(TRUSS_FRUIT)
    for index, size in enumerate(sizes):
        z_m = FIRST_TRUSS_M + TRUSS_APART_M * index + rng.normal(0.0, 0.008)
        azimuth = DOCK_SIDE_RAD * (-1.0) ** index * rng.uniform(0.1, 0.9)
        shrub.trusses.append(_truss(_along(spine, z_m), azimuth, size, index >= bearing, rng))


def _truss(root: npt.NDArray[np.float64], azimuth: float, size: int, flowering: bool, rng: np.random.Generator) -> Truss:
    """A drooping axis; pedicels leave it left and right in turn and bend down at their joints."""
    out = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
    side = np.array([-out[1], out[0], 0.0])
    rods, places = [], []
    before, step_m = root, PEDUNCLE_M
    slope = 0.15
    for nth in range(size):
        along = out * math.cos(slope) + np.array([0.0, 0.0, math.sin(slope)])
        at = before + along * step_m
        thick_m = AXIS_RADIUS_M[0] + (AXIS_RADIUS_M[1] - AXIS_RADIUS_M[0]) * nth / TRUSS_FRUIT
        rods.append(Rod(a=_point(before), b=_point(at), radius_m=max(thick_m, AXIS_RADIUS_M[1])))
        reach_m = float(np.clip(rng.normal(0.018, 0.001), 0.016, 0.020))
        knuckle = at + side * (-1.0) ** nth * reach_m + rng.normal(0.0, 0.001, 3)
        rods.append(Rod(a=_point(at), b=_point(knuckle), radius_m=PEDICEL_RADIUS_M))
        places.append(Place(knuckle=_point(knuckle), stalk_m=float(rng.uniform(0.008, 0.011))))
        before, step_m = at, rng.uniform(0.020, 0.026)
        slope -= 0.35
    return Truss(rods=tuple(rods), places=tuple(places), flowering=flowering)


def _point(vector: npt.NDArray[np.float64]) -> Point:
    return (float(vector[0]), float(vector[1]), float(vector[2]))


def _yaw_pitch_roll(yaw: float, pitch: float, roll: float) -> tuple[float, float, float, float]:
    """q (w, x, y, z) of Rz(yaw) Ry(pitch) Rx(roll)."""
    cy, sy = math.cos(yaw / 2), math.sin(yaw / 2)
    cp, sp = math.cos(pitch / 2), math.sin(pitch / 2)
    cr, sr = math.cos(roll / 2), math.sin(roll / 2)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )
