"""From the circles of several pictures to fruit in space: the robot's half of an inventory (paper 000, section 5).

Two ways of lifting: by a fixed radius, as the paper does, from one picture; and by triangulating bearings from all poses,
which needs no assumption about the size and is better by far. Everything in the frame that the camera poses are given in
(the plant's, as a rule) [m]; pictures in pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from core.geometry.pinhole import Camera
from core.inventory.crossing import RADII_M, crossings
from core.manipulation.servo import FRUIT_RADIUS_M, Target
from core.perception.detection import COLOURS, Colour, Detection

Array = NDArray[np.float64]

RADIUS_PRIOR_SIGMA_M = 0.005
"""How fruit of all ages differ in size."""
BEARING_SIGMA_PX = 1.5
BEARING_SIGMA_RATIO = 0.08
"""Part of the circle's radius by which its centre is off: leaves cut pieces off a fruit."""
SIZE_SIGMA_RATIO = 0.15
SAME_FRUIT_M = 0.012
"""Two tracks nearer than this are one fruit: no two ripe fruit share so much room."""
TURNED_MIN, TURNED_RATIO = 6, 2.0
"""So many circles must agree with the pictures turned, and this many times more than without, to believe it."""
SURE_ODDS, ODDS_STEEP, ODDS_RANGE = 1.0, 3.0, (-3.0, 4.0)
"""Log-odds that a circle is of a fruit: `SURE_ODDS` for one that just stands for itself, and so many times steeper than its
confidence's own (counted on recorded scans: the network is too modest about good circles and too kind to poor ones)."""
AGREED = {
    "all": -1.0, "best": 0.80, "second": 0.73, "others": 0.43, "more": 0.95, "absent": -0.64, "large": -2.1, "small": 0.94,
}  # fmt: skip
"""Log-odds of a fruit that several pictures agree on (a logistic fit to 1350 of them, in 64 scans of 16 gardens): by the
odds of its best circle, the second and the others, the number of pictures beyond two, those that should show it and do not,
millimetres above `LARGE_RADIUS_M`, and below `SMALL_RADIUS_M`: the network is less sure of small ones."""
LARGE_RADIUS_M, SMALL_RADIUS_M, SMALLER_M_MAX = 0.016, 0.009, 0.004
SAID_MIN = 0.2
"""What is less likely than this a fruit is not told of."""
ROUNDS, ROUNDS_PLAIN = 12, 4
"""Of Gauss-Newton: the first find the neighbourhood, in the rest an outlier loses its weight."""


@dataclass(frozen=True, slots=True, kw_only=True)
class View:
    """One pose of the scan and what was detected from it."""

    T_plant_cam: Array
    detections: tuple[Detection, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Seen:
    """One fruit as a scan has it."""

    p: Array
    """(3,) [m]."""
    sigma_m: float
    radius_m: float
    colour: Colour
    confidence: float
    views: tuple[int, ...]
    """Indices of the views that saw it."""
    best_view: int
    image_x_px: float
    image_y_px: float


@dataclass(slots=True)
class _Track:
    target: Target
    hits: dict[int, Detection] = field(default_factory=dict)


def lift_fixed_radius(camera: Camera, T_plant_cam: Array, seen: Detection, radius_m: float = FRUIT_RADIUS_M) -> Array:
    """The paper's depth: (3,) [m], where a ball of `radius_m` would look this large."""
    z_m = camera.fx * radius_m / max(seen.radius_px, 1e-6)
    p_cam = np.array([(seen.u_px - camera.cx) / camera.fx * z_m, (seen.v_px - camera.cy) / camera.fy * z_m, z_m])
    lifted: Array = T_plant_cam[:3, :3] @ p_cam + T_plant_cam[:3, 3]
    return lifted


def triangulate(
    camera: Camera, poses: Sequence[Array], circles: Sequence[Detection], start: Array, radius_m: float = FRUIT_RADIUS_M
) -> tuple[Array, Array, float]:
    """Position (3,), covariance (3, 3) [m] and radius [m] of one ball seen as `circles` from `poses` (T_plant_cam).

    Gauss-Newton on bearings and apparent sizes, the radius being an unknown with a prior round `radius_m`: one view gives
    the paper's depth, several give a triangulated one.
    """
    x = np.array([*start, radius_m])
    prior = np.diag([1e-6, 1e-6, 1e-6, RADIUS_PRIOR_SIGMA_M**-2])
    information = prior
    for number in range(ROUNDS):
        information, pull = prior.copy(), prior @ (np.array([*x[:3], radius_m]) - x)
        for T, circle in zip(poses, circles, strict=True):
            J, gap, weights = _residual(camera, T, circle, x, robust=number >= ROUNDS_PLAIN)
            information += J.T @ (weights[:, None] * J)
            pull += J.T @ (weights * gap)
        step = np.linalg.solve(information, pull)
        x = x + step
        x[3] = min(max(x[3], RADII_M[0]), RADII_M[1])
        if number > ROUNDS_PLAIN and float(np.abs(step).max()) < 1e-5:
            break
    covariance = np.linalg.inv(information)
    return x[:3], covariance[:3, :3], float(x[3])


def _residual(camera: Camera, T: Array, circle: Detection, x: Array, *, robust: bool) -> tuple[Array, Array, Array]:
    """Jacobian (3, 4), gap (3,) and weights (3,) of one circle."""
    R = T[:3, :3]
    p = R.T @ (x[:3] - T[:3, 3])
    z = max(float(p[2]), 0.02)
    fx, fy = camera.fx, camera.fy
    expected = np.array([fx * p[0] / z + camera.cx, fy * p[1] / z + camera.cy, fx * x[3] / z])
    d = np.array([[fx / z, 0, -fx * p[0] / z**2], [0, fy / z, -fy * p[1] / z**2], [0, 0, -fx * x[3] / z**2]])
    J = np.zeros((3, 4))
    J[:, :3] = d @ R.T
    J[2, 3] = fx / z
    side = BEARING_SIGMA_PX + BEARING_SIGMA_RATIO * circle.radius_px
    size = 1.0 + SIZE_SIGMA_RATIO * circle.radius_px
    gap = circle.features - expected
    sigmas = np.array([side, side, size])
    weights = sigmas**-2
    if robust:
        # Cauchy's weight: one wrong circle must not drag the fruit along.
        weights = weights / (1.0 + (gap / (3.0 * sigmas)) ** 2)
    return J, gap, weights


def fuse(camera: Camera, views: Sequence[View], radius_m: float = FRUIT_RADIUS_M, sure_min: float = 0.0) -> list[Seen]:
    """The fruit of a whole scan, each once. A circle less confident than `sure_min` does not stand for itself.

    What several pictures agree on (`crossing`) is told with the probability that it is a fruit. What no other view supports
    stays alone, at the paper's depth.
    """
    circles = [(index, circle) for index, view in enumerate(views) for circle in view.detections]
    if not circles:
        return []
    crossed = crossings(camera, [view.T_plant_cam for view in views], circles, _odds(circles, sure_min))
    tracks = [_Track(Target(p_base=c.p, P=np.eye(3) * 0.01**2, radius_m=c.radius_m), c.hits) for c in crossed]
    for track in tracks:
        _settle(camera, views, track, radius_m)
    owned = {id(circle) for track in tracks for circle in track.hits.values()}
    for index, circle in circles:
        alone = circle.confidence >= sure_min and id(circle) not in owned
        if alone and not _explained(camera, views, index, circle, tracks):
            tracks.append(_born(camera, index, views[index], circle, radius_m))
    merged = _merged(tracks)
    seen = [_seen(track, _confidence(camera, views, track, merged, sure_min)) for track in merged]
    return [fruit for fruit in seen if len(fruit.views) == 1 or fruit.confidence >= SAID_MIN]


def _odds(circles: Sequence[tuple[int, Detection]], sure_min: float) -> Array:
    """Log-odds (M,) that each circle is of a fruit. Where every circle stands for itself, its word is taken."""
    confidence = np.clip([circle.confidence for _, circle in circles], 0.02, 0.98)
    said = np.log(confidence / (1.0 - confidence))
    if sure_min <= 0.0:
        return np.clip(said, SURE_ODDS, ODDS_RANGE[1])
    steep: Array = SURE_ODDS + ODDS_STEEP * (said - np.log(sure_min / (1.0 - sure_min)))
    return np.clip(steep, *ODDS_RANGE)


def _confidence(camera: Camera, views: Sequence[View], track: _Track, others: Sequence[_Track], sure_min: float) -> float:
    """The probability that it is a fruit; a circle that stands alone says what the detector said."""
    if len(track.hits) == 1:
        return min(0.95 * hit.confidence for hit in track.hits.values())
    best, second, *rest = sorted(_odds(list(track.hits.items()), sure_min), reverse=True)
    absent = sum(
        1 for index, view in enumerate(views) if index not in track.hits and _should_show(camera, view, track, others)
    )
    odds = (
        AGREED["all"] + AGREED["best"] * best + AGREED["second"] * second + AGREED["others"] * sum(rest)
        + AGREED["more"] * len(rest) + AGREED["absent"] * absent
        + AGREED["large"] * 1e3 * max(0.0, track.target.radius_m - LARGE_RADIUS_M)
        + AGREED["small"] * 1e3 * min(SMALLER_M_MAX, max(0.0, SMALL_RADIUS_M - track.target.radius_m))
    )  # fmt: skip
    return float(1.0 / (1.0 + np.exp(-odds)))


def _should_show(camera: Camera, view: View, track: _Track, others: Sequence[_Track]) -> bool:
    """Whether it is well inside the picture, and no other fruit before it."""
    z = _expected(track.target, camera, view.T_plant_cam)
    if z is None or not (z[2] < z[0] < camera.width - z[2] and z[2] < z[1] < camera.height - z[2]):
        return False
    for other in others:
        nearer = _expected(other.target, camera, view.T_plant_cam)
        if other is track or nearer is None or nearer[2] / other.target.radius_m <= z[2] / track.target.radius_m:
            continue
        if np.hypot(nearer[0] - z[0], nearer[1] - z[1]) < nearer[2] + 0.3 * z[2]:
            return False
    return True


def upside_down(camera: Camera, views: Sequence[View]) -> bool:
    """Whether the pictures agree with one another far better when each is turned by 180 degrees.

    A camera that was mounted the wrong way round sees fruit move against the arm: bearings of one fruit do not meet.
    """
    upright, turned = _agreement(camera, views), _agreement(camera, [_turned(camera, view) for view in views])
    return turned >= TURNED_MIN and turned > TURNED_RATIO * upright


def _agreement(camera: Camera, views: Sequence[View]) -> int:
    """How many circles belong to fruit that three pictures or more show."""
    circles = [(index, circle) for index, view in enumerate(views) for circle in view.detections]
    if not circles:
        return 0
    poses = [view.T_plant_cam for view in views]
    agreed = crossings(camera, poses, circles, np.full(len(circles), SURE_ODDS), careful=False)
    return sum(len(crossing.hits) for crossing in agreed if len(crossing.hits) > 2)


def _turned(camera: Camera, view: View) -> View:
    circles = (
        replace(circle, u_px=camera.width - circle.u_px, v_px=camera.height - circle.v_px) for circle in view.detections
    )
    return replace(view, detections=tuple(circles))


def _explained(camera: Camera, views: Sequence[View], index: int, circle: Detection, tracks: Sequence[_Track]) -> bool:
    """A circle of a known fruit, cut short or shifted by a leaf: near it in the picture, and no other circle is its own."""
    for track in tracks:
        own = track.hits.get(index)
        if own is not None and not _overlap(own, circle):
            continue
        z = _expected(track.target, camera, views[index].T_plant_cam)
        if z is None or circle.radius_px > 1.6 * z[2] or not _may_be_one(track, circle):
            continue
        if np.hypot(z[0] - circle.u_px, z[1] - circle.v_px) < 0.8 * max(z[2], circle.radius_px):
            return True
    return False


def _expected(target: Target, camera: Camera, T: Array) -> Array | None:
    p = (target.p_base - T[:3, 3]) @ T[:3, :3]
    return target.features(camera, T) if p[2] > 0.03 else None


def _overlap(a: Detection, b: Detection) -> bool:
    """Two circles of one picture that share most of their area: the detector saw one fruit twice."""
    return float(np.hypot(a.u_px - b.u_px, a.v_px - b.v_px)) < 0.7 * max(a.radius_px, b.radius_px)


def _born(camera: Camera, index: int, view: View, circle: Detection, radius_m: float) -> _Track:
    p = lift_fixed_radius(camera, view.T_plant_cam, circle, radius_m)
    away = p - view.T_plant_cam[:3, 3]
    range_m = float(np.linalg.norm(away))
    ray = away / range_m
    across_m = (BEARING_SIGMA_PX + BEARING_SIGMA_RATIO * circle.radius_px) * range_m / camera.fx
    along_m = range_m * 0.25
    P = across_m**2 * (np.eye(3) - np.outer(ray, ray)) + along_m**2 * np.outer(ray, ray)
    return _Track(Target(p_base=p, P=P, radius_m=radius_m), {index: circle})


def _may_be_one(track: _Track, circle: Detection) -> bool:
    """Green and red are never one fruit within one scan; turning goes with both."""
    colours = {hit.colour for hit in track.hits.values()} | {circle.colour}
    return not {"green", "red"} <= colours


def _settle(camera: Camera, views: Sequence[View], track: _Track, radius_m: float) -> None:
    poses = [views[index].T_plant_cam for index in track.hits]
    start = track.target.p_base
    p, P, radius = triangulate(camera, poses, list(track.hits.values()), start, radius_m)
    track.target = Target(p_base=p, P=P, radius_m=radius)


def _merged(tracks: list[_Track]) -> list[_Track]:
    """Join tracks that stand in one place, unless some picture shows them side by side."""
    kept: list[_Track] = []
    for track in sorted(tracks, key=lambda t: (-len(t.hits), t.target.sigma_m)):
        twin = next((other for other in kept if _twins(other, track)), None)
        if twin is None:
            kept.append(track)
        else:
            twin.hits = track.hits | twin.hits
    return kept


def _twins(a: _Track, b: _Track) -> bool:
    gap = a.target.p_base - b.target.p_base
    both = set(a.hits) & set(b.hits)
    if any(not _overlap(a.hits[view], b.hits[view]) for view in both):
        return False
    if {"green", "red"} <= {hit.colour for hit in (*a.hits.values(), *b.hits.values())}:
        return False
    spread = a.target.P + b.target.P + np.eye(3) * (SAME_FRUIT_M / 3) ** 2
    return float(gap @ np.linalg.solve(spread, gap)) < 9.0 and float(np.linalg.norm(gap)) < 0.04


def _seen(track: _Track, confidence: float) -> Seen:
    votes: dict[Colour, float] = {
        colour: sum(h.confidence for h in track.hits.values() if h.colour == colour) for colour in COLOURS
    }
    best = max(track.hits, key=lambda view: (track.hits[view].confidence, -view))
    return Seen(
        p=track.target.p_base,
        sigma_m=track.target.sigma_m,
        radius_m=track.target.radius_m,
        colour=max(COLOURS, key=lambda colour: votes[colour]),
        confidence=confidence,
        views=tuple(sorted(track.hits)),
        best_view=best,
        image_x_px=track.hits[best].u_px,
        image_y_px=track.hits[best].v_px,
    )
