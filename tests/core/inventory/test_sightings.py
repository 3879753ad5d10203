"""Circles of six pictures become fruit: each once, where it is, however large, with clutter and gaps."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import Literal

import numpy as np
import pytest

from core.geometry.pinhole import from_fov
from core.inventory.crossing import Crossing, crossings
from core.inventory.sightings import View, fuse, lift_fixed_radius, triangulate, upside_down
from core.manipulation.eye import camera_pose, scan_poses
from core.manipulation.servo import Target
from core.perception.detection import Detection
from core.robots.gardener import CAMERA_FOV_Y_DEG

CAMERA = from_fov(640, 480, math.radians(CAMERA_FOV_Y_DEG))
POSES = [camera_pose(q) for q in scan_poses()]


def circle(p: np.ndarray, radius_m: float, T: np.ndarray, colour: Literal["green", "turning", "red"]) -> Detection | None:
    ahead = T[:3, :3].T @ (p - T[:3, 3])
    if ahead[2] < 0.08:
        return None
    u, v, r = Target(p_base=p, P=np.eye(3), radius_m=radius_m).features(CAMERA, T)
    inside = r < u < CAMERA.width - r and r < v < CAMERA.height - r
    return Detection(u_px=u, v_px=v, radius_px=r, colour=colour, confidence=0.8) if inside else None


def noisy(c: Detection, rng: np.random.Generator) -> Detection:
    return Detection(
        u_px=c.u_px + rng.normal(0, 1.5),
        v_px=c.v_px + rng.normal(0, 1.5),
        radius_px=c.radius_px * (1 + rng.normal(0, 0.06)),
        colour=c.colour,
        confidence=c.confidence,
    )


def garden(rng: np.random.Generator) -> list[tuple[np.ndarray, float, Literal["green", "red"]]]:
    """Two dozen fruit on four trusses."""
    fruit: list[tuple[np.ndarray, float, Literal["green", "red"]]] = []
    for truss in range(4):
        root = np.array([0.47, rng.uniform(-0.10, 0.10), 0.40 + 0.10 * truss])
        for nth in range(6):
            p = root + np.array([-0.012 * nth, 0.018 * (-1) ** nth, -0.02 * nth]) + rng.normal(0, 0.002, 3)
            fruit.append((p, float(rng.uniform(0.011, 0.016)), "red" if truss < 2 else "green"))
    return fruit


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_fruit_seen_from_two_poses_are_found_once_within_a_centimetre(seed: int) -> None:
    rng = np.random.default_rng(seed)
    fruit = garden(rng)
    views: list[View] = []
    times = [0] * len(fruit)
    for T in POSES:
        found = []
        for index, (p, radius_m, colour) in enumerate(fruit):
            c = circle(p, radius_m, T, colour)
            if c is not None and rng.uniform() < 0.8:
                found.append(noisy(c, rng))
                times[index] += 1
        views.append(View(T_plant_cam=T, detections=tuple(found)))
    visible = [index for index, count in enumerate(times) if count > 1]
    seen = [s for s in fuse(CAMERA, views) if len(s.views) > 1]
    truth = np.array([p for p, _, _ in fruit])
    gaps = np.array([np.linalg.norm(truth - s.p, axis=1) for s in seen])
    nearest = gaps.argmin(axis=1)
    near = gaps.min(axis=1) < 0.01
    recall = len(set(nearest[near]) & set(visible)) / len(visible)
    precision = len(set(nearest[near])) / len(seen)
    print(f"seed {seed}: {len(visible)} visible, {len(seen)} said, recall {recall:.2f}, precision {precision:.2f}")
    assert recall >= 0.9
    assert precision >= 0.9
    assert float(np.median(gaps.min(axis=1))) < 0.005
    assert all(s.colour == fruit[n][2] for s, n in zip(seen, nearest, strict=True))


def test_triangulation_beats_the_fixed_radius_for_a_large_fruit() -> None:
    p, radius_m = np.array([0.44, 0.03, 0.55]), 0.0165
    views = [(T, c) for T in POSES if (c := circle(p, radius_m, T, "red")) is not None]
    single = lift_fixed_radius(CAMERA, *views[0])
    found, covariance, radius = triangulate(CAMERA, [T for T, _ in views], [c for _, c in views], single)
    assert float(np.linalg.norm(single - p)) > 0.03
    assert float(np.linalg.norm(found - p)) < 0.003
    assert radius == pytest.approx(radius_m, abs=0.0005)
    assert 0 < math.sqrt(np.trace(covariance)) < 0.02


def test_a_circle_that_only_one_picture_shows_stays_a_doubtful_fruit_at_the_paper_s_depth() -> None:
    stray = Detection(u_px=320, v_px=240, radius_px=20, colour="red", confidence=0.4)
    views = [View(T_plant_cam=T, detections=(stray,) if n == 0 else ()) for n, T in enumerate(POSES)]
    (only,) = fuse(CAMERA, views)
    assert only.views == (0,)
    assert only.confidence < 0.5
    assert only.sigma_m > 0.03
    np.testing.assert_allclose(only.p, lift_fixed_radius(CAMERA, POSES[0], stray), atol=1e-3)


def test_nothing_seen_is_no_fruit() -> None:
    assert fuse(CAMERA, [View(T_plant_cam=T, detections=()) for T in POSES]) == []
    assert fuse(CAMERA, []) == []


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_camera_that_hangs_upside_down_is_noticed_and_an_upright_one_is_not_blamed(seed: int) -> None:
    rng = np.random.default_rng(seed)
    fruit = garden(rng)
    circles = [[noisy(c, rng) for p, r, colour in fruit if (c := circle(p, r, T, colour)) is not None] for T in POSES]
    turned = [
        [
            Detection(u_px=640 - c.u_px, v_px=480 - c.v_px, radius_px=c.radius_px, colour=c.colour, confidence=c.confidence)
            for c in view
        ]
        for view in circles
    ]
    upright = [View(T_plant_cam=T, detections=tuple(view)) for T, view in zip(POSES, circles, strict=True)]
    hanging = [View(T_plant_cam=T, detections=tuple(view)) for T, view in zip(POSES, turned, strict=True)]
    assert not upside_down(CAMERA, upright)
    assert upside_down(CAMERA, hanging)


def faint(c: Detection, confidence: float) -> Detection:
    return replace(c, confidence=confidence)


def test_faint_circles_are_a_fruit_when_several_pictures_show_them_at_one_point() -> None:
    p = np.array([0.47, 0.02, 0.55])
    circles = [circle(p, 0.012, T, "green") for T in POSES]
    views = [View(T_plant_cam=T, detections=(faint(c, 0.3),) if c else ()) for T, c in zip(POSES, circles, strict=True)]
    (found,) = fuse(CAMERA, views, sure_min=0.36)
    assert float(np.linalg.norm(found.p - p)) < 0.003
    assert 0.6 < found.confidence < 1.0


def test_a_faint_circle_that_stands_alone_is_none() -> None:
    c = circle(np.array([0.47, 0.02, 0.55]), 0.012, POSES[3], "green")
    assert c is not None
    views = [View(T_plant_cam=T, detections=(faint(c, 0.3),) if i == 3 else ()) for i, T in enumerate(POSES)]
    assert fuse(CAMERA, views, sure_min=0.36) == []
    assert len(fuse(CAMERA, views, sure_min=0.25)) == 1


# Which rays cross at a fruit

SURE_MIN = 0.4


def pictures(rng: np.random.Generator, *, shown: float, clutter: int) -> tuple[list[View], np.ndarray, list[int]]:
    """Two dozen fruit, each circle of which is `shown` so often, and faint circles where there is nothing; the fruit's
    places and how many pictures show each."""
    fruit = garden(rng)
    times, views = [0] * len(fruit), []
    for T in POSES:
        found = []
        for index, (p, radius_m, colour) in enumerate(fruit):
            c = circle(p, radius_m, T, colour)
            if c is not None and rng.uniform() < shown:
                found.append(replace(noisy(c, rng), confidence=float(rng.uniform(0.5, 0.85))))
                times[index] += 1
        for _ in range(clutter):
            at = rng.uniform((60.0, 60.0, 8.0, 0.15), (580.0, 420.0, 24.0, 0.35))
            found.append(Detection(u_px=at[0], v_px=at[1], radius_px=at[2], colour="green", confidence=at[3]))
        views.append(View(T_plant_cam=T, detections=tuple(found)))
    return views, np.array([p for p, _, _ in fruit]), times


def right(found: list[np.ndarray], truth: np.ndarray) -> set[int]:
    """The fruit that one of the points lies at."""
    gaps = [np.linalg.norm(truth - p, axis=1) for p in found]
    return {int(gap.argmin()) for gap in gaps if gap.min() < 0.01}


def test_among_faint_circles_of_nothing_the_fruit_are_told_and_little_else() -> None:
    told = shown = truly = 0
    for seed in (1, 2, 3):
        views, truth, times = pictures(np.random.default_rng(seed), shown=0.75, clutter=3)
        said = [s for s in fuse(CAMERA, views, sure_min=SURE_MIN) if len(s.views) > 1 and s.confidence >= 0.5]
        there = {index for index, count in enumerate(times) if count > 1}
        hit = right([s.p for s in said], truth)
        print(f"seed {seed}: {len(there)} shown twice, {len(said)} said, {len(hit)} right")
        assert len(hit & there) >= 0.9 * len(there)
        told, shown, truly = told + len(said), shown + len(there), truly + len(hit)
    assert truly >= 0.95 * told


def chosen(views: list[View], *, careful: bool) -> list[Crossing]:
    circles = [(index, c) for index, view in enumerate(views) for c in view.detections]
    odds = np.array([3.0 if c.confidence > 0.5 else 0.0 for _, c in circles])
    return crossings(CAMERA, [view.T_plant_cam for view in views], circles, odds, careful=careful)


def test_a_wrong_crossing_is_taken_back_when_more_is_explained_without_it() -> None:
    """Three fruit of a truss, the first half hidden in one picture: its neighbour's ray there is the nearer."""
    fruit = np.array([(0.545, -0.096, 0.428), (0.508, -0.092, 0.412), (0.506, -0.098, 0.369)])
    radii = (0.0133, 0.0140, 0.0127)
    # fruit, picture, by how much the circle is off (u, v, r) [px], and its confidence
    seen = (
        (0, 0, (-0.9, -5.4, -3.2), 0.33), (1, 0, (1.5, 0.6, 0.0), 0.84), (2, 0, (1.0, -0.2, -0.6), 0.81),
        (0, 2, (1.9, 0.3, 1.9), 0.64),
        (0, 3, (1.9, 0.6, 0.9), 0.78), (1, 3, (0.7, 1.4, 0.3), 0.77), (2, 3, (1.9, 1.7, 0.4), 0.74),
    )  # fmt: skip
    found: dict[int, list[Detection]] = {n: [] for n in range(len(POSES))}
    for index, picture, (du, dv, dr), confidence in seen:
        c = circle(fruit[index], radii[index], POSES[picture], "green")
        assert c is not None
        off = replace(c, u_px=c.u_px + du, v_px=c.v_px + dv, radius_px=c.radius_px + dr, confidence=confidence)
        found[picture].append(off)
    views = [View(T_plant_cam=T, detections=tuple(found[n])) for n, T in enumerate(POSES)]
    assert right([c.p for c in chosen(views, careful=False)], fruit) == {2}
    assert right([c.p for c in chosen(views, careful=True)], fruit) == {0, 1, 2}


def test_each_circle_belongs_to_one_point_and_each_point_has_one_circle_of_a_picture() -> None:
    views, _, _ = pictures(np.random.default_rng(4), shown=0.8, clutter=6)
    found = chosen(views, careful=True)
    used = [id(hit) for crossing in found for hit in crossing.hits.values()]
    assert len(used) == len(set(used))
    assert all(len(crossing.hits) > 1 for crossing in found)


def test_a_picture_that_should_show_a_fruit_and_does_not_makes_it_less_likely() -> None:
    p = np.array([0.44, 0.0, 0.55])
    circles = [circle(p, 0.013, T, "green") for T in POSES]
    showing = [index for index, c in enumerate(circles) if c is not None]

    def said(looked: list[int]) -> float:
        views = [
            View(
                T_plant_cam=POSES[n], detections=(replace(c, confidence=0.6),) if c is not None and n in showing[:2] else ()
            )
            for n, c in enumerate(circles)
            if n in looked
        ]
        return max(s.confidence for s in fuse(CAMERA, views, sure_min=SURE_MIN))

    told = [said(showing[:count]) for count in range(2, len(showing) + 1)]
    print("confidence by pictures:", [round(value, 2) for value in told])
    assert len(told) >= 3
    assert all(a > b for a, b in itertools.pairwise(told))
