"""What surfaces look like close by: leaf veins, ripening skin with its calyx, hairy stems, soil, turf, clay, walls.

Everything is a function of a point on the surface, in the frame of its own geom where that moves, so that the same leaf
looks the same from everywhere.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from sim.camera.geoms import ASTROTURF, CLAY, FRUIT, LEAF, SOIL, STEM, Floats

_jit = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
SEPALS = 5
CALYX_RAD = 0.95
"""How far a sepal reaches down from the stalk, as an angle at the fruit's centre."""
SHOULDER_RIPENESS, MOTTLE_RIPENESS = 0.16, 0.10
"""A fruit ripens from below: by so much is its top behind its bottom. And in blotches."""
VEINS = 5.0
"""On either side of a leaf's midrib."""
_SEPAL = (0.10, 0.25, 0.06)
"""Linear colours from here on."""


@_jit
def chance(i: int, j: int, k: int) -> float:
    """A hash of three whole numbers, 0-1."""
    h = np.uint32(i) * np.uint32(0x8DA6B343) ^ np.uint32(j) * np.uint32(0xD8163841) ^ np.uint32(k) * np.uint32(0xCB1AB31F)
    h = np.uint32(h ^ (h >> np.uint32(15))) * np.uint32(0x2C1B3C6D)
    h = np.uint32(h ^ (h >> np.uint32(12))) * np.uint32(0x297A2D39)
    return float(np.uint32(h ^ (h >> np.uint32(15)))) / 4294967296.0


@_jit
def noise(x: float, y: float, z: float, cell_m: float, pixel_m: float) -> float:
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
        total += weight * chance(int(i) + a, int(j) + b, int(k) + c)
    return fade * (total - 0.5)


@_jit
def _fade(rgb: Floats, red: float, green: float, blue: float) -> None:
    """A plain green made as dull as living and woven things are: what is added to red and blue, what is left of green."""
    rgb[0] = 0.6 * rgb[0] + red * rgb[1]
    rgb[2] = 0.6 * rgb[2] + blue * rgb[1]
    rgb[1] *= green


@_jit
def _leaf(geom: int, q: Floats, size: Floats, pixel_m: float, rgb: Floats, m: Floats) -> None:
    """Veins as lighter lines with a fold on either side; every leaf a little yellower or bluer than the next."""
    along, across = q[0] / size[0], q[1] / size[1]
    side = 1.0 if across >= 0 else -1.0
    vein = VEINS * (0.5 + 0.5 * along) - 1.6 * abs(across)
    vein -= math.floor(vein)
    fine = min(1.0, 0.004 / max(pixel_m, 1e-9))
    under = 1.0 if m[2] < 0 else 0.0
    tone = 1.0 + 0.30 * noise(q[0], q[1], 7.0 * geom, 0.011, pixel_m) + 0.22 * noise(q[0], q[1], 3.0 * geom, 0.003, pixel_m)
    line = max(0.0, 1.0 - abs(vein - 0.5) * 14.0) + max(0.0, 1.0 - abs(across) * 16.0)
    tone *= 1.0 + fine * 0.45 * min(line, 1.0)
    hue = chance(geom, 3, 5) - 0.5
    _fade(rgb, 0.32, 0.92, 0.18)
    pale = 1.0 + 0.5 * under
    rgb[0] *= tone * pale * (1.0 + 0.7 * max(hue, 0.0) + 0.25 * hue)
    rgb[1] *= tone * pale * (1.0 + 0.12 * hue)
    rgb[2] *= tone * pale * (1.0 + 0.5 * under - 0.3 * hue)
    # The blade is a shallow trough along its midrib, and bulges between the veins.
    m[1] -= m[2] * side * 0.30
    bulge = fine * 0.45 * (vein - 0.5)
    m[0] -= m[2] * bulge
    m[1] += m[2] * side * bulge * 0.8


@_jit
def _fruit(geom: int, q: Floats, size: Floats, ripeness: float, skin: Floats, pixel_m: float, rgb: Floats) -> float:
    """Skin that ripens from below, under a star of sepals. Returns how much of the gloss remains."""
    r = size[0]
    x, y, z = q[0] / r, q[1] / r, q[2] / r
    phase = math.tau * chance(geom, 1, 1)
    down = math.acos(max(-1.0, min(1.0, z)))
    turn = (math.atan2(y, x) + phase) * SEPALS / math.tau
    sepal = math.floor(turn + 0.5)
    across = math.sin(down) * (turn - sepal) * math.tau / SEPALS
    length = CALYX_RAD * (0.75 + 0.45 * chance(geom, int(sepal) % SEPALS, 2))
    if (down < length and abs(across) < 0.20 * (1.0 - down / length) + 0.02) or down < 0.16:
        shade = 0.75 + 0.5 * chance(geom, int(sepal) % SEPALS, 4) - 1.5 * abs(across)
        for i in range(3):
            rgb[i] = _SEPAL[i] * shade * (1.0 + 0.4 * (1.0 - ripeness))
        return 0.1
    blotch = noise(x, y, z + 5.0 * geom, 0.45, 0.0) + 0.5 * noise(x, y, z + 5.0 * geom, 0.16, pixel_m / r)
    turning = max(0.0, 1.0 - abs(ripeness - 0.6) / 0.4)
    local = ripeness - turning * (SHOULDER_RIPENESS * 0.5 * z - MOTTLE_RIPENESS * blotch)
    at = max(0.0, min(local, 1.0)) * (len(skin) - 1)
    low = min(int(at), len(skin) - 2)
    share = at - low
    tone = 1.0 + 0.12 * noise(x, y, z + 9.0 * geom, 0.09, pixel_m / r) + 0.15 * (chance(geom, 8, 8) - 0.5)
    # Green shoulders round the stalk of what is not ripe; a paler belly.
    tone *= 1.0 - 0.22 * max(0.0, z - 0.2) * (1.0 - ripeness)
    for i in range(3):
        rgb[i] = tone * (skin[low, i] + share * (skin[low + 1, i] - skin[low, i]))
    return 1.0


@_jit
def paint(
    texture: int,
    geom: int,
    p: Floats,
    q: Floats,
    size: Floats,
    ripeness: float,
    skin: Floats,
    pixel_m: float,
    rgb: Floats,
    m: Floats,
) -> float:
    """Colour a point: rgb (3,) and the normal m (3,) in the geom's frame are changed in place; returns the gloss's share.

    p (3,) [m] in the world, q (3,) in the geom's frame; `pixel_m` is what a pixel covers there.
    """
    x, y, z = p[0], p[1], p[2]
    tone = 1.0
    if texture == LEAF:
        _leaf(geom, q, size, pixel_m, rgb, m)
    elif texture == FRUIT:
        return _fruit(geom, q, size, ripeness, skin, pixel_m, rgb)
    elif texture == STEM:
        tone += 0.35 * noise(q[0], q[1], q[2] + geom, 0.004, pixel_m) + 0.25 * noise(q[0], q[1], q[2] + geom, 0.02, pixel_m)
        rgb[0] *= 1.0 + 0.5 * noise(q[0], q[1], q[2] + 2.0 * geom, 0.03, pixel_m)
    elif texture == ASTROTURF:
        _fade(rgb, 0.20, 0.72, 0.10)
        blades = 0.75 * noise(x + 0.4 * y, 3.0 * y, z, 0.006, pixel_m)
        tone += blades + 0.25 * noise(x, y, z, 0.03, pixel_m) + 0.22 * noise(x, y, z, 0.35, pixel_m)
        rgb[0] *= 1.0 + 0.5 * noise(x, y, z + 1.0, 0.012, pixel_m)
    elif texture == SOIL:
        tone += 0.9 * noise(x, y, z, 0.008, pixel_m) + 0.5 * noise(x, y, z, 0.025, pixel_m)
        tone += 0.7 * noise(x, y, z + 3.0, 0.003, pixel_m)
        m[0] += 0.7 * noise(x, y, z + 5.0, 0.010, pixel_m)
        m[1] += 0.7 * noise(x, y, z + 6.0, 0.010, pixel_m)
    elif texture == CLAY:
        tone += 0.16 * noise(x, y, z, 0.003, pixel_m) + 0.30 * noise(x, y, 0.4 * z, 0.05, pixel_m)
    for i in range(3):
        rgb[i] *= tone
    return 1.0


@_jit
def wall(eye: Floats, d: Floats, half_m: Floats, base: Floats, rgb: Floats) -> None:
    """What is behind everything: the room's walls and ceiling, with panels, stains and, high up, bright windows."""
    t = 1e9
    face = 0
    for k in range(3):
        if abs(d[k]) > 1e-9:
            away = ((half_m[k] if d[k] > 0 else -half_m[k]) - eye[k]) / d[k]
            if 0.0 < away < t:
                t, face = away, k
    x, y, z = eye[0] + t * d[0], eye[1] + t * d[1], eye[2] + t * d[2]
    along = y if face == 0 else x
    tone = 1.0 + 0.20 * noise(x, y, z, 0.7, 0.0) + 0.10 * noise(x, y, z, 0.09, 0.0)
    window = False
    if face != 2:
        tone *= 0.62 + 0.20 * min(max(z, 0.0), 2.0)
        panel = along / 0.9 - math.floor(along / 0.9)
        if panel < 0.03 or panel > 0.97:
            tone *= 0.72
        glazed = chance(int(along // 0.9), face, int(d[face] > 0)) > 0.45
        window = glazed and 1.05 < z < 2.1 and 0.12 < panel < 0.88
    for i in range(3):
        rgb[i] = base[i] * tone
    if window:
        leafy = 0.5 + 1.2 * noise(x, y, z, 0.22, 0.0) + 0.8 * noise(x, y, z, 0.07, 0.0)
        rgb[0] = base[0] * (1.35 - 0.75 * leafy)
        rgb[1] = base[1] * (1.40 - 0.50 * leafy)
        rgb[2] = base[2] * (1.45 - 0.85 * leafy)
