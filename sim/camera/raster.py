"""Screen-space raster of MuJoCo primitives: per pixel the geom, its distance and its normal.

Each geom is intersected exactly, but only with the rays inside the rectangle that its outline covers in the picture.
An ellipsoid's outline follows from its dual quadric (Hartley & Zisserman, Multiple View Geometry, section 8.3); a capsule
lies within the hull of two spheres, a cylinder within that of two discs, a box within that of its corners.
Agrees with `mujoco.mj_multiRay`, which is far slower.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numba
import numpy as np
import numpy.typing as npt

from core.geometry.pinhole import Camera, directions
from sim.camera.geoms import Floats, Geoms, Ints

PLANE, SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX = 0, 2, 3, 4, 5, 6
"""mjtGeom; other kinds (height fields, meshes) are not drawn."""
_NEAR_M = 1e-4
_TINY = 1e-15
LEAF_TEETH = 6.0
"""On either side of a leaf."""
_SLACK = 1e-9

_jit = numba.njit(cache=True, nogil=True, fastmath=False)
_jit_inline = numba.njit(cache=True, nogil=True, fastmath=False, inline="always")


@dataclass(frozen=True, slots=True, kw_only=True)
class Raster:
    """One picture's geometry."""

    ids: Ints
    """(H, W) geom id; -1 where nothing is hit."""
    distance_m: Floats
    """(H, W) along the unit ray; inf where nothing is hit."""
    normal: npt.NDArray[np.float32]
    """(H, W, 3), world, towards the outside of the geom."""


def rasterise(camera: Camera, T_world_cam: Floats, geoms: Geoms, *, normals: bool = True) -> Raster:
    """What the camera at T_world_cam (4, 4) sees; without `normals` those stay zero. Releases the GIL while it works."""
    shape = (camera.height, camera.width)
    ids = np.full(shape, -1, dtype=np.int32)
    distance_m = np.full(shape, np.inf)
    normal = np.zeros((*shape, 3), dtype=np.float32)
    rays, columns, rows = lens_of(camera)
    T = np.ascontiguousarray(T_world_cam, dtype=np.float64)
    _draw(T, columns, rows, rays, geoms.kind, geoms.size, geoms.pos, geoms.mat, geoms.visible, geoms.leaf, ids, distance_m)
    if normals:
        _normals(T, rays, geoms.kind, geoms.size, geoms.pos, geoms.mat, ids, distance_m, normal)
    return Raster(ids=ids, distance_m=distance_m, normal=normal)


@lru_cache(maxsize=4)
def lens_of(camera: Camera) -> tuple[Floats, Floats, Floats]:
    """Unit rays (H, W, 3) in the camera frame, and `_ranges` of them; not to be written to."""
    rays = directions(camera)
    return rays, *_ranges(rays)


def _ranges(rays: Floats) -> tuple[Floats, Floats]:
    """What the rays of each column span in x at depth 1, and those of each row in y: (2, W) and (2, H), lower and upper.

    Both never fall from left to right, so that a search finds a geom's columns whatever the lens does.
    """
    x, y = rays[..., 0] / rays[..., 2], rays[..., 1] / rays[..., 2]
    return _rising(x.min(axis=0), x.max(axis=0)), _rising(y.min(axis=1), y.max(axis=1))


def _rising(lower: Floats, upper: Floats) -> Floats:
    return np.stack([np.minimum.accumulate(lower[::-1])[::-1], np.maximum.accumulate(upper)])


@_jit_inline
def _quadratic(a: float, b: float, c: float) -> tuple[float, float]:
    """Roots of a t^2 + 2 b t + c, smaller first; (-1, -1) without."""
    det = b * b - a * c
    if det < _TINY or a < _TINY:
        return -1.0, -1.0
    root = math.sqrt(det)
    return (-b - root) / a, (-b + root) / a


@_jit_inline
def _hit_plane(o: Floats, d: Floats, size: Floats) -> float:
    if d[2] > -_TINY:
        return -1.0
    t = -o[2] / d[2]
    if t < 0:
        return -1.0
    inside_x = size[0] <= 0 or abs(o[0] + t * d[0]) <= size[0]
    inside_y = size[1] <= 0 or abs(o[1] + t * d[1]) <= size[1]
    return t if inside_x and inside_y else -1.0


@_jit_inline
def _hit_ellipsoid(o: Floats, d: Floats, size: Floats) -> float:
    a = b = 0.0
    c = -1.0
    for k in range(3):
        s = 1.0 / (size[k] * size[k])
        a += s * d[k] * d[k]
        b += s * d[k] * o[k]
        c += s * o[k] * o[k]
    t0, t1 = _quadratic(a, b, c)
    return t0 if t0 >= 0 else t1


@_jit_inline
def _hit_sphere_at(o: Floats, d: Floats, z: float, radius: float, end: float) -> float:
    """The sphere round (0, 0, z), only where its surface lies beyond z in the direction of `end`."""
    oz = o[2] - z
    b = d[0] * o[0] + d[1] * o[1] + d[2] * oz
    t0, t1 = _quadratic(1.0, b, o[0] * o[0] + o[1] * o[1] + oz * oz - radius * radius)
    if t0 >= 0 and (oz + t0 * d[2]) * end >= 0:
        return t0
    if t1 >= 0 and (oz + t1 * d[2]) * end >= 0:
        return t1
    return -1.0


@_jit_inline
def _hit_side(o: Floats, d: Floats, radius: float, half: float) -> float:
    """The round side of a cylinder along z."""
    a = d[0] * d[0] + d[1] * d[1]
    t0, t1 = _quadratic(a, d[0] * o[0] + d[1] * o[1], o[0] * o[0] + o[1] * o[1] - radius * radius)
    if t0 >= 0 and abs(o[2] + t0 * d[2]) <= half:
        return t0
    if t1 >= 0 and abs(o[2] + t1 * d[2]) <= half:
        return t1
    return -1.0


@_jit_inline
def _nearer(a: float, b: float) -> float:
    """The smaller of two distances, where negative means no hit."""
    if a < 0:
        return b
    return a if b < 0 or a < b else b


@_jit_inline
def _hit_capsule(o: Floats, d: Floats, size: Floats) -> float:
    t = _hit_side(o, d, size[0], size[1])
    t = _nearer(t, _hit_sphere_at(o, d, size[1], size[0], 1.0))
    return _nearer(t, _hit_sphere_at(o, d, -size[1], size[0], -1.0))


@_jit_inline
def _hit_cylinder(o: Floats, d: Floats, size: Floats) -> float:
    t = _hit_side(o, d, size[0], size[1])
    if abs(d[2]) > _TINY:
        for end in (-1.0, 1.0):
            cap = (end * size[1] - o[2]) / d[2]
            x, y = o[0] + cap * d[0], o[1] + cap * d[1]
            if cap >= 0 and x * x + y * y <= size[0] * size[0]:
                t = _nearer(t, cap)
    return t


@_jit_inline
def _hit_box(o: Floats, d: Floats, size: Floats) -> float:
    t_in, t_out = -np.inf, np.inf
    for k in range(3):
        if abs(d[k]) < _TINY:
            if abs(o[k]) > size[k]:
                return -1.0
            continue
        t0, t1 = (-size[k] - o[k]) / d[k], (size[k] - o[k]) / d[k]
        t_in = max(t_in, min(t0, t1))
        t_out = min(t_out, max(t0, t1))
    if t_in > t_out or t_out < 0:
        return -1.0
    return t_in if t_in >= 0 else t_out


@_jit_inline
def _hit(kind: int, o: Floats, d: Floats, size: Floats) -> float:
    if kind in (ELLIPSOID, SPHERE):
        return _hit_ellipsoid(o, d, size)
    if kind == CAPSULE:
        return _hit_capsule(o, d, size)
    if kind == CYLINDER:
        return _hit_cylinder(o, d, size)
    if kind == BOX:
        return _hit_box(o, d, size)
    return _hit_plane(o, d, size)


@_jit_inline
def _in_leaf(o: Floats, d: Floats, size: Floats, t: float) -> bool:
    """Whether an ellipsoid's surface point belongs to the leaf in it: from its foot at -x to its tip at +x."""
    along = 0.5 + 0.5 * (o[0] + t * d[0]) / size[0]
    if along <= 0.0 or along >= 1.0:
        return False
    across = abs(o[1] + t * d[1]) / size[1]
    # Egg-shaped and drawn out to a point, its edge in teeth that lean forward.
    width = math.sin(math.pi * along**0.72) * (1.0 - 0.35 * along)
    tooth = LEAF_TEETH * along - 0.8 * across
    return bool(across <= width * (1.12 - 0.34 * (tooth - math.floor(tooth))))


@_jit
def _widen(spread: Floats, c: Floats, extent: Floats) -> bool:
    """Grow `extent` (x0, x1, y0, y1 at depth 1) by the outline of the ellipsoid {c, spread}; False if it reaches behind."""
    if c[2] - math.sqrt(max(spread[2, 2], 0.0)) <= _NEAR_M:
        return False
    q22 = c[2] * c[2] - spread[2, 2]
    for k in range(2):
        q02 = c[k] * c[2] - spread[k, 2]
        q00 = c[k] * c[k] - spread[k, k]
        root = math.sqrt(max(q02 * q02 - q00 * q22, 0.0))
        extent[2 * k] = min(extent[2 * k], (q02 - root) / q22)
        extent[2 * k + 1] = max(extent[2 * k + 1], (q02 + root) / q22)
    return True


@_jit
def _outline(kind: int, R: Floats, c: Floats, size: Floats, extent: Floats) -> int:
    """The rectangle round a geom in the picture, at depth 1 (R, c: geom in the camera). 0 unseen, 1 boxed, 2 anywhere."""
    extent[0] = extent[2] = np.inf
    extent[1] = extent[3] = -np.inf
    spread = np.zeros((3, 3))
    if kind == PLANE:
        return 2
    ahead = True
    reach = 0.0
    if kind == BOX:
        p = np.empty(3)
        for corner in range(8):
            for i in range(3):
                p[i] = c[i]
                for k in range(3):
                    p[i] += R[i, k] * size[k] * (1.0 if corner >> k & 1 else -1.0)
            ahead = _widen(spread, p, extent) and ahead
            reach = max(reach, p[2])
    else:
        flat = 0.0 if kind == CYLINDER else 1.0
        r0, r1, r2 = size[0], size[0], size[0] * flat
        if kind == ELLIPSOID:
            r1, r2 = size[1], size[2]
        for i in range(3):
            for k in range(3):
                spread[i, k] = R[i, 0] * R[k, 0] * r0 * r0 + R[i, 1] * R[k, 1] * r1 * r1 + R[i, 2] * R[k, 2] * r2 * r2
        depth = math.sqrt(max(spread[2, 2], 0.0))
        if kind in (CAPSULE, CYLINDER):
            axis = R[:, 2] * size[1]
            ahead = _widen(spread, c + axis, extent) and _widen(spread, c - axis, extent)
            reach = c[2] + abs(axis[2]) + depth
        else:
            ahead = _widen(spread, c, extent)
            reach = c[2] + depth
    if reach <= 0:
        return 0
    return 1 if ahead else 2


@_jit
def _span(low: float, high: float, reach: Floats) -> tuple[int, int]:
    """Range [first, last) of the columns or rows (`_ranges`) whose rays can meet low..high at depth 1."""
    first = int(np.searchsorted(reach[1], low - _SLACK))
    last = int(np.searchsorted(reach[0], high + _SLACK, side="right"))
    return first, max(first, last)


@_jit
def _draw(
    T: Floats,
    columns: Floats,
    rows: Floats,
    rays: Floats,
    kinds: Ints,
    sizes: Floats,
    positions: Floats,
    mats: Floats,
    visible: npt.NDArray[np.bool_],
    leaves: npt.NDArray[np.bool_],
    ids: Ints,
    distance_m: Floats,
) -> None:
    height, width = ids.shape
    R_cam_world = np.ascontiguousarray(T[:3, :3].T)
    eye = T[:3, 3].copy()
    extent = np.empty(4)
    d = np.empty(3)
    form = np.empty(9)
    reach = np.empty(len(kinds))
    for g in range(len(kinds)):
        reach[g] = np.linalg.norm(positions[g] - eye) - _bound(kinds[g], sizes[g])
    for g in np.argsort(reach):
        kind, leaf, nearest = kinds[g], leaves[g], reach[g]
        if not visible[g] or not (kind == PLANE or SPHERE <= kind <= BOX):
            continue
        size = sizes[g].copy()
        if kind == SPHERE:
            size[1] = size[2] = size[0]
        R_world_geom = np.ascontiguousarray(mats[g]).reshape(3, 3)
        M = np.ascontiguousarray((R_cam_world @ R_world_geom).T)
        c = R_cam_world @ (positions[g] - eye)
        o = -(M @ c)
        seen = _outline(kind, np.ascontiguousarray(M.T), c, size, extent)
        if seen == 0:
            continue
        u0, u1, v0, v1 = 0, width, 0, height
        if seen == 1:
            u0, u1 = _span(extent[0], extent[1], columns)
            v0, v1 = _span(extent[2], extent[3], rows)
        rounded = _round_form(kind, M, o, size, form)
        for v in range(v0, v1):
            for u in range(u0, u1):
                if nearest >= distance_m[v, u]:
                    continue
                x, y, z = rays[v, u, 0], rays[v, u, 1], rays[v, u, 2]
                if rounded and _misses(form, x, y, z):
                    continue
                d[0] = M[0, 0] * x + M[0, 1] * y + M[0, 2] * z
                d[1] = M[1, 0] * x + M[1, 1] * y + M[1, 2] * z
                d[2] = M[2, 0] * x + M[2, 1] * y + M[2, 2] * z
                t = _hit(kind, o, d, size)
                if 0.0 <= t < distance_m[v, u] and (not leaf or _in_leaf(o, d, size, t)):
                    distance_m[v, u] = t
                    ids[v, u] = g


@_jit
def _bound(kind: int, size: Floats) -> float:
    """Radius of a ball round a geom's origin that holds it."""
    if kind == PLANE:
        return np.inf
    if kind == SPHERE:
        x, y, z = size[0], 0.0, 0.0
    elif kind == CAPSULE:
        x, y, z = size[0] + size[1], 0.0, 0.0
    elif kind == CYLINDER:
        x, y, z = size[0], size[1], 0.0
    else:
        x, y, z = size[0], size[1], size[2]
    return math.sqrt(x * x + y * y + z * z)


@_jit
def _round_form(kind: int, M: Floats, o: Floats, size: Floats, form: Floats) -> bool:
    """For round geoms: (b^2 - a c) of their quadratic, or of the endless cylinder round them, as a form in the ray.

    form: xx, yy, zz, xy, xz, yz of a symmetric matrix; where it is negative the ray misses.
    """
    if kind in (BOX, PLANE):
        return False
    weight = np.empty(3)
    for k in range(3):
        if kind in (SPHERE, ELLIPSOID):
            weight[k] = 1.0 / (size[k] * size[k])
        else:
            weight[k] = 1.0 / (size[0] * size[0]) if k < 2 else 0.0
    c = -1.0
    for k in range(3):
        c += weight[k] * o[k] * o[k]
    for index in range(6):
        i, j = (0, 1, 2, 0, 0, 1)[index], (0, 1, 2, 1, 2, 2)[index]
        a = bi = bj = 0.0
        for k in range(3):
            a += weight[k] * M[k, i] * M[k, j]
            bi += weight[k] * M[k, i] * o[k]
            bj += weight[k] * M[k, j] * o[k]
        form[index] = (1.0 if index < 3 else 2.0) * (bi * bj - a * c)
    form[6] = 1e-9 * max(abs(form[0]), abs(form[1]), abs(form[2]))
    return True


@_jit_inline
def _misses(form: Floats, x: float, y: float, z: float) -> bool:
    det = x * (form[0] * x + form[3] * y + form[4] * z) + y * (form[1] * y + form[5] * z) + form[2] * z * z
    return bool(det < -form[6])


@_jit
def _normal(kind: int, p: Floats, size: Floats, n: Floats) -> None:
    """Outward normal n (3,) at a surface point p (3,), both in the geom's frame; not yet of unit length."""
    n[0], n[1], n[2] = p[0], p[1], p[2]
    if kind == ELLIPSOID:
        for k in range(3):
            n[k] = p[k] / (size[k] * size[k])
    elif kind == CAPSULE:
        n[2] = p[2] - max(-size[1], min(size[1], p[2]))
    elif kind == CYLINDER:
        on_cap = abs(p[2]) > size[1] - 1e-9
        n[0], n[1], n[2] = (0.0, 0.0, p[2]) if on_cap else (p[0], p[1], 0.0)
    elif kind == BOX:
        face = 0
        for k in range(1, 3):
            if abs(abs(p[k]) - size[k]) < abs(abs(p[face]) - size[face]):
                face = k
        n[0] = n[1] = n[2] = 0.0
        n[face] = p[face]
    elif kind == PLANE:
        n[0], n[1], n[2] = 0.0, 0.0, 1.0


@_jit
def _normals(
    T: Floats,
    rays: Floats,
    kinds: Ints,
    sizes: Floats,
    positions: Floats,
    mats: Floats,
    ids: Ints,
    distance_m: Floats,
    normal: npt.NDArray[np.float32],
) -> None:
    height, width = ids.shape
    offset, p, n = np.empty(3), np.empty(3), np.empty(3)
    for v in range(height):
        for u in range(width):
            g = ids[v, u]
            if g < 0:
                continue
            t = distance_m[v, u]
            for i in range(3):
                along = T[i, 0] * rays[v, u, 0] + T[i, 1] * rays[v, u, 1] + T[i, 2] * rays[v, u, 2]
                offset[i] = T[i, 3] + t * along - positions[g, i]
            for i in range(3):
                p[i] = mats[g, i] * offset[0] + mats[g, 3 + i] * offset[1] + mats[g, 6 + i] * offset[2]
            _normal(kinds[g], p, sizes[g], n)
            length = math.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2])
            for i in range(3):
                world = mats[g, 3 * i] * n[0] + mats[g, 3 * i + 1] * n[1] + mats[g, 3 * i + 2] * n[2]
                normal[v, u, i] = world / max(length, _TINY)
