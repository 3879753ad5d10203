"""Light on a raster: lamps, light from all around and what keeps it out, highlights, one lamp's shadow."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np
import numpy.typing as npt

from core.geometry.pinhole import Camera, from_fov, look_at
from sim.camera.geoms import FRUIT, LAMP, LEAF, SKIN_RGB, STEM, Floats, Geoms, Ints, Paint
from sim.camera.raster import Raster, lens_of, rasterise
from sim.camera.skins import chance, paint, wall

Picture = npt.NDArray[np.uint8]
"""(H, W, 3) BGR."""
Linear = npt.NDArray[np.float32]
"""(H, W, 3) RGB, as much light as falls on each pixel; 1 is what a white sheet under the lamps sends."""

_jit = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
GAMMA = 1.6
_CURVE = (255.0 * (np.arange(1025) / 1024.0) ** (1.0 / GAMMA) + 0.5).astype(np.uint8)
"""From linear light, 0-1 in 1024 steps, to a pixel."""
SHADOW_PIXELS = 768
SHADOW_BIAS_M = 0.02
SHADOW_DEPTH = 0.62
"""How much of the lamp's own light a shadow takes away."""
LEAF_PASSES = (0.16, 0.42, 0.05)
"""What a leaf's shadow gets nevertheless, through the leaf, per colour."""
NOOK_M = 0.025
"""Things within this reach keep light from all around out."""
NOOK_DEPTH = 0.85
NOOK_SAMPLES, NOOK_TURNS = 9, 16
WALLS_M = (4.0, 3.6, 2.6)
"""Half the room's length and width, and its height: only looked at where nothing stands before it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Lamp:
    """A point light whose strength does not fall with distance, as of a large panel."""

    pos_m: tuple[float, float, float]
    rgb: tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Light:
    """All light of a picture; `exposure` scales it."""

    lamps: tuple[Lamp, ...]
    ambient_rgb: tuple[float, float, float] = (0.34, 0.35, 0.38)
    sky_rgb: tuple[float, float, float] = (0.80, 0.83, 0.86)
    """The walls, seen where nothing is."""
    exposure: float = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ShadowMap:
    """Distances as seen from a lamp, and whether a leaf is there."""

    camera: Camera
    T_world_lamp: Floats
    distance_m: Floats
    leaf: npt.NDArray[np.bool_]
    bias_m: float = SHADOW_BIAS_M


class _Scene(NamedTuple):
    """Geoms and paint as the kernel takes them; colours linear."""

    albedo: Floats
    texture: Ints
    gloss: Floats
    ripeness: Floats
    pos: Floats
    mat: Floats
    size: Floats
    skin: Floats
    spiral: Floats
    lamps_m: Floats
    lamps_rgb: Floats
    ambient_rgb: Floats
    sky_rgb: Floats


class _Shadow(NamedTuple):
    lens: Floats
    T_world_lamp: Floats
    distance_m: Floats
    leaf: npt.NDArray[np.bool_]
    bias_m: float


def cast_shadow(
    lamp: Lamp,
    geoms: Geoms,
    centre_m: Sequence[float],
    reach_m: float,
    pixels: int = SHADOW_PIXELS,
    bias_m: float = SHADOW_BIAS_M,
) -> ShadowMap:
    """What the lamp sees of the sphere of `reach_m` round `centre_m`."""
    eye, target = np.array(lamp.pos_m), np.array(centre_m, dtype=np.float64)
    fov_rad = 2 * math.asin(min(0.99, reach_m / float(np.linalg.norm(target - eye))))
    camera = from_fov(pixels, pixels, fov_rad)
    T_world_lamp = look_at(eye, target, np.array([0.0, 1.0, 0.01]))
    raster = rasterise(camera, T_world_lamp, geoms, normals=False)
    leaf = np.append(geoms.leaf, False)[raster.ids]
    return ShadowMap(camera=camera, T_world_lamp=T_world_lamp, distance_m=raster.distance_m, leaf=leaf, bias_m=bias_m)


def expose(
    camera: Camera,
    T_world_cam: Floats,
    raster: Raster,
    geoms: Geoms,
    paint: Paint,
    light: Light,
    shadow: ShadowMap | None = None,
) -> Linear:
    """The light that falls on each pixel; `shadow` belongs to the first lamp. Releases the GIL while it works."""
    film = np.empty((camera.height, camera.width, 3), dtype=np.float32)
    lamps_m = np.array([lamp.pos_m for lamp in light.lamps], dtype=np.float64).reshape(-1, 3)
    lamps_rgb = np.array([lamp.rgb for lamp in light.lamps], dtype=np.float64).reshape(-1, 3) * light.exposure
    scene = _Scene(
        albedo=np.ascontiguousarray(paint.rgba[:, :3] ** GAMMA),
        texture=paint.texture,
        gloss=paint.gloss,
        ripeness=paint.ripeness,
        pos=geoms.pos,
        mat=geoms.mat,
        size=geoms.size,
        skin=SKIN_RGB**GAMMA,
        spiral=_SPIRAL,
        lamps_m=lamps_m,
        lamps_rgb=lamps_rgb,
        ambient_rgb=np.array(light.ambient_rgb) * light.exposure,
        sky_rgb=np.array(light.sky_rgb) ** GAMMA * light.exposure,
    )
    T = np.ascontiguousarray(T_world_cam, dtype=np.float64)
    _paint(T, lens_of(camera)[0], camera.fx, raster.ids, raster.distance_m, raster.normal, scene, _arrays(shadow), film)
    return film


def shade(
    camera: Camera,
    T_world_cam: Floats,
    raster: Raster,
    geoms: Geoms,
    paint: Paint,
    light: Light,
    shadow: ShadowMap | None = None,
) -> Picture:
    """The raster's colours as an ideal camera gives them."""
    film = expose(camera, T_world_cam, raster, geoms, paint, light, shadow)
    return tone(film)


def tone(film: Linear) -> Picture:
    """From light to pixels, by the curve."""
    return np.ascontiguousarray(_CURVE[(1024.0 * np.clip(film, 0.0, 1.0)).astype(np.int16)][..., ::-1])


def _arrays(shadow: ShadowMap | None) -> _Shadow:
    if shadow is None:
        return _Shadow(np.zeros(4), np.eye(4), np.empty((0, 0)), np.empty((0, 0), dtype=np.bool_), 0.0)
    camera = shadow.camera
    lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    return _Shadow(lens, shadow.T_world_lamp, shadow.distance_m, shadow.leaf, shadow.bias_m)


@_jit
def _lit(p: Floats, shadow: _Shadow, lit: Floats) -> None:
    """How much of the shadow-casting lamp reaches p, 0-1 for each colour, softened over 3 x 3 pixels."""
    lit[0] = lit[1] = lit[2] = 1.0
    height, width = shadow.distance_m.shape
    if height == 0:
        return
    x = y = z = 0.0
    T = shadow.T_world_lamp
    for k in range(3):
        away = p[k] - T[k, 3]
        x += T[k, 0] * away
        y += T[k, 1] * away
        z += T[k, 2] * away
    if z <= 0:
        return
    distance = math.sqrt(x * x + y * y + z * z) - shadow.bias_m
    u, v = math.floor(shadow.lens[0] * x / z + shadow.lens[2]), math.floor(shadow.lens[1] * y / z + shadow.lens[3])
    if not (1 <= u < width - 1 and 1 <= v < height - 1):
        return
    kept = through = 0
    for du in range(-1, 2):
        for dv in range(-1, 2):
            if distance > shadow.distance_m[v + dv, u + du]:
                kept += 1
                if shadow.leaf[v + dv, u + du]:
                    through += 1
    for i in range(3):
        lit[i] = 1.0 - SHADOW_DEPTH * (kept - through * LEAF_PASSES[i]) / 9.0


@_jit
def _openness(
    rays: Floats, distance_m: Floats, ids: Ints, u: int, v: int, fx: float, n_cam: Floats, spiral: Floats
) -> float:
    """How much of the light from all around reaches a pixel, from some pixels about it; n_cam: its normal in the camera."""
    height, width = ids.shape
    t = distance_m[v, u]
    reach = min(max(fx * NOOK_M / t, 2.0), 0.08 * width)
    x0, y0, z0 = t * rays[v, u, 0], t * rays[v, u, 1], t * rays[v, u, 2]
    start = NOOK_SAMPLES * int(NOOK_TURNS * chance(u, v, 1))
    kept = 0.0
    for k in range(start, start + NOOK_SAMPLES):
        x, y = u + int(reach * spiral[k, 0]), v + int(reach * spiral[k, 1])
        if not (0 <= x < width and 0 <= y < height) or ids[y, x] < 0:
            continue
        s = distance_m[y, x]
        gx, gy, gz = s * rays[y, x, 0] - x0, s * rays[y, x, 1] - y0, s * rays[y, x, 2] - z0
        up = gx * n_cam[0] + gy * n_cam[1] + gz * n_cam[2]
        far2 = gx * gx + gy * gy + gz * gz
        if up > 0.0005 and far2 < 4 * NOOK_M * NOOK_M:
            kept += up / math.sqrt(far2)
    return 1.0 - NOOK_DEPTH * min(1.0, 2.0 * kept / NOOK_SAMPLES)


def _spirals() -> Floats:
    """Where to look about a pixel, within a circle of radius 1: NOOK_TURNS spirals of NOOK_SAMPLES points, turned."""
    turn, k = np.arange(NOOK_TURNS)[:, None], np.arange(NOOK_SAMPLES)[None, :]
    angle = math.tau * turn / NOOK_TURNS + 2.4 * k
    far = (k + 0.5) / NOOK_SAMPLES
    return np.stack([far * np.cos(angle), far * np.sin(angle)], axis=2).reshape(-1, 2)


_SPIRAL = _spirals()


@_jit
def _power(x: float, doublings: int) -> float:
    """x to the power 2^doublings."""
    for _ in range(doublings):
        x *= x
    return x


@_jit
def _add_lamp(
    p: Floats,
    n: Floats,
    to_eye: Floats,
    lamp_m: Floats,
    lamp_rgb: Floats,
    gloss: float,
    texture: int,
    lit: Floats,
    light: Floats,
) -> None:
    """Add one lamp's diffuse light to light[:3] and its highlight to light[3:]."""
    x, y, z = lamp_m[0] - p[0], lamp_m[1] - p[1], lamp_m[2] - p[2]
    length = max(math.sqrt(x * x + y * y + z * z), 1e-9)
    x, y, z = x / length, y / length, z / length
    facing = n[0] * x + n[1] * y + n[2] * z
    diffuse = max(facing, 0.0)
    if texture == FRUIT:
        # Light enters the flesh and comes out again a little beyond the shadow's edge.
        diffuse = max(facing + 0.25, 0.0) / 1.25
    glint = 0.0
    if gloss > 0.0 and facing > 0.0:
        hx, hy, hz = x + to_eye[0], y + to_eye[1], z + to_eye[2]
        half = math.sqrt(hx * hx + hy * hy + hz * hz)
        cosine = max((n[0] * hx + n[1] * hy + n[2] * hz) / max(half, 1e-9), 0.0)
        glint = gloss * (_power(cosine, 7) * 1.4 + 0.2 * _power(cosine, 4) if texture == FRUIT else _power(cosine, 5))
    through = max(-facing, 0.0) if texture == LEAF else 0.0
    for i in range(3):
        # Thin leaves let some light through from behind, greener than what they send back.
        light[i] += (lit[i] * diffuse + through * (0.30, 0.42, 0.15)[i]) * lamp_rgb[i]
        light[3 + i] += lit[i] * glint * lamp_rgb[i]


@_jit
def _paint(
    T: Floats,
    rays: Floats,
    fx: float,
    ids: Ints,
    distance_m: Floats,
    normal: npt.NDArray[np.float32],
    scene: _Scene,
    shadow: _Shadow,
    film: Linear,
) -> None:
    height, width = ids.shape
    p, q, n, m, eye = np.empty(3), np.empty(3), np.empty(3), np.empty(3), T[:3, 3].copy()
    to_eye, along, light, rgb, lit, full = np.empty(3), np.empty(3), np.empty(6), np.empty(3), np.empty(3), np.ones(3)
    n_cam, walls = np.empty(3), np.array(WALLS_M)
    for v in range(height):
        for u in range(width):
            g = ids[v, u]
            for i in range(3):
                along[i] = T[i, 0] * rays[v, u, 0] + T[i, 1] * rays[v, u, 1] + T[i, 2] * rays[v, u, 2]
            if g < 0:
                wall(eye, along, walls, scene.sky_rgb, rgb)
                for i in range(3):
                    film[v, u, i] = rgb[i]
                continue
            t = distance_m[v, u]
            texture = scene.texture[g]
            for i in range(3):
                to_eye[i], p[i], n[i] = -along[i], eye[i] + t * along[i], normal[v, u, i]
                rgb[i] = scene.albedo[g, i]
            if texture == LAMP:
                for i in range(3):
                    film[v, u, i] = rgb[i]
                continue
            R = scene.mat[g]
            for i in range(3):
                q[i] = m[i] = 0.0
                for k in range(3):
                    q[i] += R[3 * k + i] * (p[k] - scene.pos[g, k])
                    m[i] += R[3 * k + i] * n[k]
            for i in range(3):
                n_cam[i] = T[0, i] * n[0] + T[1, i] * n[1] + T[2, i] * n[2]
            open_to = _openness(rays, distance_m, ids, u, v, fx, n_cam, scene.spiral)
            gloss = scene.gloss[g] * paint(texture, g, p, q, scene.size[g], scene.ripeness[g], scene.skin, t / fx, rgb, m)
            length = math.sqrt(m[0] * m[0] + m[1] * m[1] + m[2] * m[2])
            for i in range(3):
                n[i] = (R[3 * i] * m[0] + R[3 * i + 1] * m[1] + R[3 * i + 2] * m[2]) / length
            # Light from above is stronger than light from below.
            for i in range(3):
                light[i], light[3 + i] = open_to * scene.ambient_rgb[i] * (0.75 + 0.25 * n[2]), 0.0
            for lamp in range(len(scene.lamps_m)):
                if lamp == 0:
                    _lit(p, shadow, lit)
                _add_lamp(
                    p,
                    n,
                    to_eye,
                    scene.lamps_m[lamp],
                    scene.lamps_rgb[lamp],
                    gloss,
                    texture,
                    lit if lamp == 0 else full,
                    light,
                )
            rim = 1.0 - abs(n[0] * to_eye[0] + n[1] * to_eye[1] + n[2] * to_eye[2])
            if texture == STEM:
                # Fine hairs catch the light at the edge.
                for i in range(3):
                    light[i] *= 1.0 + 0.9 * rim * rim * rim
            elif texture == FRUIT:
                for i in range(3):
                    light[3 + i] += open_to * gloss * (0.05 + 0.5 * rim**5) * scene.ambient_rgb[i]
            for i in range(3):
                film[v, u, i] = max(0.0, rgb[i] * light[i] + light[3 + i])
