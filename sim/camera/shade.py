"""Light on a raster: lamps, ambient light, highlights, one lamp's shadow, and textures fixed to the world."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np
import numpy.typing as npt

from core.geometry.pinhole import Camera, directions, from_fov, look_at
from sim.camera.geoms import ASTROTURF, LAMP, LEAF, SOIL, Floats, Geoms, Ints, Paint
from sim.camera.raster import Raster, rasterise

Picture = npt.NDArray[np.uint8]
"""(H, W, 3) BGR."""

_jit = numba.njit(cache=True, nogil=True, error_model="numpy")
_GAMMA = 1.6
_CURVE = (255.0 * (np.arange(1025) / 1024.0) ** (1.0 / _GAMMA) + 0.5).astype(np.uint8)
"""From linear light, 0-1 in 1024 steps, to a pixel."""
SHADOW_PIXELS = 768
SHADOW_BIAS_M = 0.02
SHADOW_DEPTH = 0.62
"""How much of the lamp's own light a shadow takes away."""


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
    """What is seen where nothing is."""
    exposure: float = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ShadowMap:
    """Distances as seen from a lamp."""

    camera: Camera
    T_world_lamp: Floats
    distance_m: Floats


def cast_shadow(lamp: Lamp, geoms: Geoms, centre_m: Sequence[float], reach_m: float) -> ShadowMap:
    """What the lamp sees of the sphere of `reach_m` round `centre_m`."""
    eye, target = np.array(lamp.pos_m), np.array(centre_m, dtype=np.float64)
    fov_rad = 2 * math.asin(min(0.99, reach_m / float(np.linalg.norm(target - eye))))
    camera = from_fov(SHADOW_PIXELS, SHADOW_PIXELS, fov_rad)
    T_world_lamp = look_at(eye, target, np.array([0.0, 1.0, 0.01]))
    return ShadowMap(camera=camera, T_world_lamp=T_world_lamp, distance_m=rasterise(camera, T_world_lamp, geoms).distance_m)


def shade(
    camera: Camera,
    T_world_cam: Floats,
    raster: Raster,
    paint: Paint,
    light: Light,
    shadow: ShadowMap | None = None,
) -> Picture:
    """The raster's colours; `shadow` belongs to the first lamp. Releases the GIL while it works."""
    picture = np.empty((camera.height, camera.width, 3), dtype=np.uint8)
    lamps_m = np.array([lamp.pos_m for lamp in light.lamps], dtype=np.float64).reshape(-1, 3)
    lamps_rgb = np.array([lamp.rgb for lamp in light.lamps], dtype=np.float64).reshape(-1, 3) * light.exposure
    lens, T_world_lamp, depths = _shadow_arrays(shadow)
    _paint(
        np.ascontiguousarray(T_world_cam, dtype=np.float64),
        directions(camera),
        camera.fx,
        raster.ids,
        raster.distance_m,
        raster.normal,
        paint.rgba[:, :3] ** _GAMMA,
        paint.texture,
        paint.gloss,
        lamps_m,
        lamps_rgb,
        np.array(light.ambient_rgb) * light.exposure,
        np.array(light.sky_rgb),
        lens,
        T_world_lamp,
        depths,
        _CURVE,
        picture,
    )
    return picture


def _shadow_arrays(shadow: ShadowMap | None) -> tuple[Floats, Floats, Floats]:
    if shadow is None:
        return np.zeros(4), np.eye(4), np.empty((0, 0))
    camera = shadow.camera
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy]), shadow.T_world_lamp, shadow.distance_m


@_jit
def _chance(i: int, j: int, k: int) -> float:
    """A hash of three whole numbers, 0-1."""
    h = np.uint32(i) * np.uint32(0x8DA6B343) ^ np.uint32(j) * np.uint32(0xD8163841) ^ np.uint32(k) * np.uint32(0xCB1AB31F)
    h = np.uint32(h ^ (h >> np.uint32(15))) * np.uint32(0x2C1B3C6D)
    h = np.uint32(h ^ (h >> np.uint32(12))) * np.uint32(0x297A2D39)
    return float(np.uint32(h ^ (h >> np.uint32(15)))) / 4294967296.0


@_jit
def _noise(x: float, y: float, z: float, cell_m: float, pixel_m: float) -> float:
    """Smooth noise -0.5..0.5 of the given grain; fades where a pixel covers more than a grain."""
    fade = min(1.0, cell_m / max(pixel_m, 1e-9))
    if fade < 0.1:
        return 0.0
    x, y, z = x / cell_m, y / cell_m, z / cell_m
    i, j, k = math.floor(x), math.floor(y), math.floor(z)
    fx, fy, fz = x - i, y - j, z - k
    total = 0.0
    for corner in range(8):
        a, b, c = corner & 1, corner >> 1 & 1, corner >> 2
        weight = (fx if a else 1.0 - fx) * (fy if b else 1.0 - fy) * (fz if c else 1.0 - fz)
        total += weight * _chance(int(i) + a, int(j) + b, int(k) + c)
    return fade * (total - 0.5)


@_jit
def _tint(texture: int, p: Floats, pixel_m: float) -> float:
    """Brightness factor of a texture at a point of the world."""
    x, y, z = p[0], p[1], p[2]
    if texture == ASTROTURF:
        blades = 0.75 * _noise(x + 0.4 * y, 3.0 * y, z, 0.006, pixel_m)
        return 1.0 + blades + 0.25 * _noise(x, y, z, 0.03, pixel_m) + 0.22 * _noise(x, y, z, 0.35, pixel_m)
    if texture == SOIL:
        return 1.0 + 0.9 * _noise(x, y, z, 0.008, pixel_m) + 0.5 * _noise(x, y, z, 0.025, pixel_m)
    if texture == LEAF:
        return 1.0 + 0.4 * _noise(x, y, z, 0.012, pixel_m) + 0.35 * _noise(x, y, z, 0.08, pixel_m)
    return 1.0


@_jit
def _lit(p: Floats, lens: Floats, T_world_lamp: Floats, depths: Floats) -> float:
    """How much of the shadow-casting lamp reaches p, 0-1, softened over 3 x 3 pixels."""
    height, width = depths.shape
    if height == 0:
        return 1.0
    x = y = z = 0.0
    for k in range(3):
        away = p[k] - T_world_lamp[k, 3]
        x += T_world_lamp[k, 0] * away
        y += T_world_lamp[k, 1] * away
        z += T_world_lamp[k, 2] * away
    if z <= 0:
        return 1.0
    distance = math.sqrt(x * x + y * y + z * z)
    u, v = math.floor(lens[0] * x / z + lens[2]), math.floor(lens[1] * y / z + lens[3])
    if not (1 <= u < width - 1 and 1 <= v < height - 1):
        return 1.0
    seen = 0
    for du in range(-1, 2):
        for dv in range(-1, 2):
            if distance <= depths[v + dv, u + du] + SHADOW_BIAS_M:
                seen += 1
    return 1.0 - SHADOW_DEPTH * (1.0 - seen / 9.0)


@_jit
def _glint(n: Floats, to_eye: Floats, lx: float, ly: float, lz: float) -> float:
    """Blinn's highlight for a unit direction to the lamp."""
    hx, hy, hz = lx + to_eye[0], ly + to_eye[1], lz + to_eye[2]
    length = math.sqrt(hx * hx + hy * hy + hz * hz)
    cosine = (n[0] * hx + n[1] * hy + n[2] * hz) / max(length, 1e-9)
    return float(max(cosine, 0.0) ** 40)


@_jit
def _add_lamp(
    p: Floats,
    n: Floats,
    to_eye: Floats,
    lamp_m: Floats,
    lamp_rgb: Floats,
    gloss: float,
    leaf: bool,
    lit: float,
    light: Floats,
) -> None:
    """Add one lamp's diffuse light to light[:3] and its highlight to light[3:]."""
    x, y, z = lamp_m[0] - p[0], lamp_m[1] - p[1], lamp_m[2] - p[2]
    length = max(math.sqrt(x * x + y * y + z * z), 1e-9)
    x, y, z = x / length, y / length, z / length
    facing = n[0] * x + n[1] * y + n[2] * z
    # Thin leaves let some light through from behind.
    diffuse = max(facing, 0.0) + (0.35 * max(-facing, 0.0) if leaf else 0.0)
    glint = gloss * _glint(n, to_eye, x, y, z) if facing > 0.0 and gloss > 0.0 else 0.0
    for i in range(3):
        light[i] += lit * diffuse * lamp_rgb[i]
        light[3 + i] += lit * glint * lamp_rgb[i]


@_jit
def _paint(
    T: Floats,
    rays: Floats,
    fx: float,
    ids: Ints,
    distance_m: Floats,
    normal: npt.NDArray[np.float32],
    albedo: Floats,
    textures: Ints,
    glosses: Floats,
    lamps_m: Floats,
    lamps_rgb: Floats,
    ambient_rgb: Floats,
    sky_rgb: Floats,
    lens: Floats,
    T_world_lamp: Floats,
    depths: Floats,
    curve: npt.NDArray[np.uint8],
    picture: Picture,
) -> None:
    height, width = ids.shape
    p, n, to_eye, light = np.empty(3), np.empty(3), np.empty(3), np.empty(6)
    for v in range(height):
        for u in range(width):
            g = ids[v, u]
            if g < 0:
                for i in range(3):
                    picture[v, u, 2 - i] = int(255.0 * sky_rgb[i])
                continue
            t = distance_m[v, u]
            for i in range(3):
                along = T[i, 0] * rays[v, u, 0] + T[i, 1] * rays[v, u, 1] + T[i, 2] * rays[v, u, 2]
                to_eye[i], p[i], n[i] = -along, T[i, 3] + t * along, normal[v, u, i]
            # Light from above is a little stronger than light from below.
            for i in range(3):
                light[i], light[3 + i] = ambient_rgb[i] * (0.8 + 0.2 * n[2]), 0.0
            if textures[g] == LAMP:
                light[0] = light[1] = light[2] = 1.0
            leaf = textures[g] == LEAF
            for lamp in range(len(lamps_m)):
                lit = _lit(p, lens, T_world_lamp, depths) if lamp == 0 else 1.0
                _add_lamp(p, n, to_eye, lamps_m[lamp], lamps_rgb[lamp], glosses[g], leaf, lit, light)
            tint = _tint(textures[g], p, t / fx)
            for i in range(3):
                linear = albedo[g, i] * tint * light[i] + light[3 + i]
                picture[v, u, 2 - i] = curve[int(1024.0 * min(max(linear, 0.0), 1.0))]
