"""The view of the camera in a robot's hand: its light, its lens, its sensor."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np

from core.geometry.pinhole import NO_DISTORTION, Camera, Distortion, from_fov
from core.robots.gardener import CAMERA_FOV_Y_DEG, CAMERA_PIXELS
from sim.camera.geoms import Floats, Geoms, Paint
from sim.camera.raster import Raster, lens_of, rasterise
from sim.camera.shade import GAMMA, Lamp, Light, Linear, Picture, cast_shadow, expose

LAMPS_TOTAL = 1.15
"""What all lamps together give to a surface that faces them."""
AMBIENT_SHARE = 0.32
"""Of the lamps' light: what comes back from walls, ceiling and leaves."""
LAMP_RGB = {
    "white": (1.0, 0.98, 0.93),
    "warm": (1.0, 0.83, 0.60),
    "daylight": (0.90, 0.97, 1.06),
    "purple": (1.0, 0.30, 0.95),
}
"""Colours of lamps; `purple` are the red and blue diodes of grow lamps."""
SHADOW_AHEAD_M, SHADOW_REACH_M, SHADOW_PIXELS, SHADOW_BIAS_M = 0.38, 0.55, 320, 0.006
"""Shadows are cast where the hand looks: round a point ahead of it."""
LAMP_DEPTH_M = 0.2
"""A lamp's own housing casts no shadow."""
WHITE = 0.42
"""Mean light that the camera's automatic exposure aims at."""
DIOPTRES_SHARP, DIOPTRES_MAX = 1.2, 4.0
"""Out of focus by less than the first is sharp; beyond the second the blur grows no more."""
GAIN_MIN, GAIN_MAX = 0.35, 3.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Sensor:
    """What lens and sensor do to the light."""

    exposure: float = 1.0
    """Factor on what the automatic exposure chooses."""
    white_balance: float = 0.75
    """How much of the lamps' tint the camera takes out, 0-1."""
    blur_px: float = 0.55
    """Sigma at 320 pixels across, where the picture is sharpest."""
    focus_m: float = 0.32
    """Fixed. Other distances are blurred the more, the further they are from it in dioptres."""
    defocus_px: float = 0.42
    """Sigma that each dioptre adds, at 320 pixels across."""
    vignette: float = 0.22
    """What the corners lose."""
    read_noise: float = 0.006
    shot_noise: float = 0.016
    """Sigma of a dark and of a white pixel at a gain of one."""


def camera(width: int, height: int, distortion: Distortion = NO_DISTORTION) -> Camera:
    """The gardener's camera, read out at this size."""
    return from_fov(*CAMERA_PIXELS, math.radians(CAMERA_FOV_Y_DEG), distortion).scaled(width, height)


def light_of(lamps_m: Floats, tint: tuple[float, float, float] = LAMP_RGB["white"], first: int = 0) -> Light:
    """Lamps (L, 3) [m] of one tint; number `first` casts the shadows and gives most of the light."""
    order = [first, *(k for k in range(len(lamps_m)) if k != first)]
    shares = [0.7, *([0.3 / (len(order) - 1)] * (len(order) - 1))] if len(order) > 1 else [1.0]

    def dimmed(share: float) -> tuple[float, float, float]:
        return (share * tint[0], share * tint[1], share * tint[2])

    lamps = tuple(
        Lamp(pos_m=(float(lamps_m[k][0]), float(lamps_m[k][1]), float(lamps_m[k][2])), rgb=dimmed(LAMPS_TOTAL * share))
        for k, share in zip(order, shares, strict=True)
    )
    walls = dimmed(0.62)
    return Light(lamps=lamps, ambient_rgb=dimmed(LAMPS_TOTAL * AMBIENT_SHARE), sky_rgb=walls)


def nearest_lamp(lamps_m: Floats, T_world_cam: Floats) -> int:
    """Which lamp hangs nearest to where the camera looks."""
    return int(np.linalg.norm(lamps_m - _ahead(T_world_cam), axis=1).argmin())


def draw(
    camera: Camera,
    T_world_cam: Floats,
    geoms: Geoms,
    paint: Paint,
    light: Light,
    sensor: Sensor = Sensor(),
    seed: int = 0,
) -> Picture:
    """The picture (H, W, 3) BGR; `seed` draws the noise. Slow (some 60 ms at 320 x 240): offload it."""
    return draw_raster(camera, T_world_cam, rasterise(camera, T_world_cam, geoms), geoms, paint, light, sensor, seed)


def draw_raster(
    camera: Camera,
    T_world_cam: Floats,
    raster: Raster,
    geoms: Geoms,
    paint: Paint,
    light: Light,
    sensor: Sensor = Sensor(),
    seed: int = 0,
) -> Picture:
    """As `draw`, of a raster that is there already."""
    ahead = _ahead(T_world_cam)
    shadow = None
    if light.lamps:
        below = replace(geoms, visible=geoms.visible & (geoms.pos[:, 2] < light.lamps[0].pos_m[2] - LAMP_DEPTH_M))
        centre = (ahead[0], ahead[1], ahead[2])
        shadow = cast_shadow(light.lamps[0], below, centre, SHADOW_REACH_M, SHADOW_PIXELS, SHADOW_BIAS_M)
    film = expose(camera, T_world_cam, raster, geoms, paint, light, shadow)
    return develop(film, raster.distance_m, light, sensor, seed)


def depth_png(camera: Camera, T_world_cam: Floats, geoms: Geoms) -> bytes:
    """Depth along the camera's axis as a PNG of 16-bit millimetres; 0 where nothing is, or further than 65 m."""
    rays = lens_of(camera)[0]
    depth_mm = 1000.0 * rasterise(camera, T_world_cam, geoms, normals=False).distance_m * rays[..., 2]
    depth_mm[~(depth_mm < 65535.0)] = 0.0
    ok, data = cv2.imencode(".png", np.rint(depth_mm).astype(np.uint16))
    if not ok:
        raise ValueError("the depth could not be encoded")
    return bytes(data)


def _ahead(T_world_cam: Floats) -> Floats:
    ahead: Floats = T_world_cam[:3, 3] + SHADOW_AHEAD_M * T_world_cam[:3, 2]
    return ahead


def covered(camera: Camera, sensor: Sensor = Sensor(), seed: int = 0) -> Picture:
    """The picture with something before the lens: the sensor's own noise."""
    shape = (camera.height, camera.width)
    return develop(np.zeros((*shape, 3), dtype=np.float32), np.full(shape, np.inf), Light(lamps=()), sensor, seed)


def develop(film: Linear, distance_m: Floats, light: Light, sensor: Sensor, seed: int) -> Picture:
    """From light to pixels (H, W, 3) BGR: blur, vignetting, exposure, white balance, noise, curve."""
    height, width = film.shape[:2]
    film = _focus(film, distance_m, sensor)
    film *= _vignette(width, height, sensor.vignette)[..., None]
    mean = float(np.minimum(film, 1.0).mean())
    gain = float(np.clip(WHITE / (mean + 0.1), GAIN_MIN, GAIN_MAX)) * sensor.exposure
    film *= (gain * _balance(light, sensor.white_balance)).astype(np.float32)
    noise = np.random.default_rng(seed).standard_normal(film.shape, dtype=np.float32)
    film += noise * np.sqrt(sensor.read_noise**2 * gain**2 + sensor.shot_noise**2 * gain * np.maximum(film, 0.0))
    steps = np.clip(film[..., ::-1] * 512.0, 0, len(_CURVE) - 1).astype(np.int16)
    picture: Picture = _CURVE[steps]
    return picture


def _focus(film: Linear, distance_m: Floats, sensor: Sensor) -> Linear:
    """The lens's blur: each pixel between a sharp picture and a soft one, by how far out of focus it is."""
    scale = film.shape[1] / 320
    sharp = cv2.GaussianBlur(film, (0, 0), sensor.blur_px * scale)
    soft_px = sensor.blur_px + sensor.defocus_px * DIOPTRES_MAX
    soft = cv2.GaussianBlur(sharp, (0, 0), soft_px * scale)
    off = np.abs(1.0 / np.maximum(distance_m, 0.02) - 1.0 / sensor.focus_m).astype(np.float32)
    share = np.clip((off - DIOPTRES_SHARP) / (DIOPTRES_MAX - DIOPTRES_SHARP), 0.0, 1.0)
    # An edge against something unsharp is unsharp itself.
    share = cv2.blur(share, (3, 3))[..., None]
    blurred: Linear = sharp + share * (soft - sharp)
    return blurred


def _film_curve() -> Picture:
    """From light (512 steps to white, four times that in all) to a pixel: highlights are compressed, not cut off."""
    light = np.arange(2048) / 512.0
    shoulder = light / (1.0 + light**3.5) ** (1 / 3.5)
    return (255.0 * shoulder ** (1.0 / GAMMA) + 0.5).astype(np.uint8)


_CURVE = _film_curve()


def _balance(light: Light, strength: float) -> Floats:
    tint = np.sum([lamp.rgb for lamp in light.lamps], axis=0) if light.lamps else np.ones(3)
    gains: Floats = (tint.mean() / np.maximum(tint, 1e-3)) ** strength
    return gains


@lru_cache(maxsize=8)
def _vignette(width: int, height: int, depth: float) -> Linear:
    x, y = np.linspace(-1, 1, width), np.linspace(-1, 1, height)
    fall: Linear = (1.0 - depth * (x[None, :] ** 2 + y[:, None] ** 2) / 2).astype(np.float32)
    return fall
