"""The filter detector: each filter does its own part, and together they find painted fruit."""

import cv2
import numpy as np
import pytest

from core.perception import filter_kernels as kernels
from core.perception import filters

SIZE = (480, 640)
LEAF = (45, 95, 60)
RED = (30, 35, 190)


def foliage(seed):
    """Leaves that cross each other, with noise."""
    rng = np.random.default_rng(seed)
    image = np.full((*SIZE, 3), (55, 75, 60), np.uint8)
    for _ in range(160):
        centre = (int(rng.integers(0, 640)), int(rng.integers(0, 480)))
        axes = (int(rng.integers(15, 70)), int(rng.integers(6, 20)))
        shade = tuple(int(c * rng.uniform(0.6, 1.3)) for c in LEAF)
        cv2.ellipse(image, centre, axes, float(rng.uniform(0, 180)), 0, 360, shade, -1, cv2.LINE_AA)
    return np.clip(image + rng.normal(0, 4, image.shape), 0, 255).astype(np.uint8)


def with_fruit(image, fruit, skin=RED):
    """Balls that darken towards their rim and shine at the top left."""
    out = image.copy()
    for u, v, radius in fruit:
        for share in np.linspace(1.0, 0.1, 12):
            shade = tuple(float(c * (1.15 - 0.5 * share**2)) for c in skin)
            cv2.circle(out, (u, v), round(radius * share), shade, -1, cv2.LINE_AA)
        cv2.circle(out, (u - radius // 3, v - radius // 3), max(radius // 8, 1), (235, 235, 235), -1, cv2.LINE_AA)
    return cv2.GaussianBlur(out, (3, 3), 0)


FRUIT = ((120, 120, 34), (330, 240, 50), (520, 100, 24), (500, 380, 40))


@pytest.fixture(scope="module")
def detect():
    return filters.filter_detector()


def near(found, fruit):
    u, v, radius = fruit
    return [d for d in found if np.hypot(d.u_px - u, d.v_px - v) < 0.5 * radius]


def test_red_balls_among_leaves_are_found_where_they_are_and_as_large_as_they_are(detect):
    found = [d for d in detect(with_fruit(foliage(1), FRUIT)) if d.colour == "red"]
    for fruit in FRUIT:
        (one,) = near(found, fruit)
        assert one.radius_px == pytest.approx(fruit[2], rel=0.3)
    assert len(found) <= len(FRUIT) + 1


def test_leaves_alone_are_no_red_fruit(detect):
    assert [d for d in detect(foliage(2)) if d.colour == "red"] == []


def test_a_purple_lamp_does_not_hide_red_fruit(detect):
    lamp = np.array([1.25, 0.65, 1.1])
    lit = np.clip(with_fruit(foliage(3), FRUIT) * lamp, 0, 255).astype(np.uint8)
    found = detect(lit)
    assert sum(bool(near(found, fruit)) for fruit in FRUIT) >= 3


def test_the_answer_is_a_function_of_the_image(detect):
    image = with_fruit(foliage(4), FRUIT)
    assert detect(image) == detect(image.copy())


@pytest.mark.parametrize("shape", [(240, 320), (768, 1024), (500, 400), (33, 40)])
@pytest.mark.parametrize("level", [0, 255])
def test_black_and_burnt_out_images_of_any_size_hold_nothing_red(detect, shape, level):
    assert [d for d in detect(np.full((*shape, 3), level, np.uint8)) if d.colour != "green"] == []


def test_a_circle_at_twice_the_size_is_found_at_twice_the_place(detect):
    small = with_fruit(foliage(5), FRUIT)
    large = cv2.resize(small, None, fx=2, fy=2, interpolation=cv2.INTER_LINEAR)
    for fruit in FRUIT:
        (one,), (other,) = near(detect(small), fruit), near(detect(large), [2 * x for x in fruit])
        assert (other.u_px, other.v_px) == pytest.approx((2 * one.u_px, 2 * one.v_px), abs=8)


def test_circle_votes_gather_at_a_discs_centre():
    disc = cv2.GaussianBlur(cv2.circle(np.zeros((40, 50), np.float32), (30, 18), 6, 1.0, -1), (3, 3), 0)
    votes = np.empty_like(disc)
    kernels.vote(disc, 0.1, 4, 8, votes)
    smoothed = cv2.GaussianBlur(votes, (5, 5), 1.2)
    assert np.unravel_index(smoothed.argmax(), votes.shape) == (18, 30)
    assert votes.sum() == pytest.approx(votes[8:29, 20:41].sum())


def test_an_outlines_radius_is_the_discs():
    disc = cv2.GaussianBlur(cv2.circle(np.zeros((60, 60), np.float32), (30, 30), 7, 1.0, -1), (3, 3), 0)
    radius, seen, step = kernels.outline(disc, 30.0, 30.0, 3.2, 10.4, filters.SPOKES)
    assert radius == pytest.approx(7.5, abs=1.2)
    assert seen == 1.0
    assert step > 0.4


def test_smoothness_falls_at_edges_and_stays_on_plains():
    step = np.zeros((20, 20), np.float32)
    step[:, 10:] = 0.5
    smooth = np.empty_like(step)
    filters.smoothness(step, smooth)
    assert smooth[10, 3] == pytest.approx(1.0)
    assert smooth[10, 10] < 0.1


def test_blobs_too_small_and_too_large_are_left_out():
    plane = np.zeros((200, 300), np.float32)
    plane[50:70, 50:70] = 1.0
    plane[10:12, 200:202] = 1.0
    wanted = np.empty_like(plane)
    filters.areas(plane, np.ones_like(plane), wanted)
    assert wanted[60, 60] == 1.0
    assert wanted[11, 201] == 0.0
    filters.areas(np.ones_like(plane), np.ones_like(plane), wanted)
    assert wanted.max() == 0.0


def test_a_highlight_is_white_and_brighter_than_all_around():
    brightness, whiteness = np.full((60, 60), 0.3, np.float32), np.full((60, 60), 0.2, np.float32)
    brightness[28:32, 28:32] = 0.9
    whiteness[28:32, 28:32] = 1.0
    spots = np.empty_like(brightness)
    filters.highlights(brightness, whiteness, spots)
    assert spots[30, 30] > 0.9
    assert spots[5, 5] == 0.0


def test_balancing_makes_the_mean_grey():
    image = np.full((40, 40, 3), (120, 60, 100), np.uint8)
    balanced = image[0, 0] * filters.gains_of(image, 1.0)
    assert np.ptp(balanced) == pytest.approx(0.0, abs=1e-6)


def test_circles_and_colour_agree_as_gaussian_and_box_say():
    rng = np.random.default_rng(11)
    votes, colour = rng.random((2, 37, 52), np.float32)
    agreed = np.empty_like(votes)
    kernels.agreement(votes, colour, agreed)
    expected = 4 * cv2.GaussianBlur(votes, (5, 5), 1.2) + 0.5 * cv2.blur(colour, (5, 5))
    assert agreed == pytest.approx(expected, abs=1e-5)


def test_a_bright_colour_is_blurred_as_a_gaussian_says():
    colour, brightness = np.random.default_rng(12).random((2, 37, 52), np.float32)
    soft = np.empty_like(colour)
    kernels.bright_colour(colour, brightness, soft)
    assert soft == pytest.approx(cv2.GaussianBlur(colour * (0.35 + 0.65 * brightness), (3, 3), 0.8), abs=1e-5)


def test_tops_are_the_highest_of_their_neighbours_and_come_best_first():
    votes = np.random.default_rng(13).random((40, 61), np.float32)
    votes[0, 0] = votes[39, 60] = 2.0
    tops = kernels.tops(votes, 0.6, 1000)
    highest = (votes >= cv2.dilate(votes, np.ones((5, 5), np.uint8))) & (votes >= 0.6)
    assert {(x, y) for x, y in tops.tolist()} == {(x, y) for y, x in np.argwhere(highest).tolist()}
    heights = votes[tops[:, 1], tops[:, 0]].tolist()
    assert heights == sorted(heights, reverse=True)
    assert kernels.tops(votes, 0.6, 3).tolist() == tops[:3].tolist()


def test_the_collective_estimate_is_the_weighted_sum_of_all_terms():
    weights = filters.packaged()
    features = np.random.default_rng(14).normal(0, 2, (9, len(filters.FEATURES))).astype(np.float32)
    for family in range(2):
        terms = filters.terms((features - weights.centre[family]) / weights.spread[family])
        odds = weights.candidate[family, 0] + terms @ weights.candidate[family, 1:]
        circles = np.zeros((9, 3), np.float32)
        estimate = filters.confidence_of(filters.Candidates(family, circles, features), weights)
        assert estimate == pytest.approx(1 / (1 + np.exp(-np.clip(odds, -30, 30))), abs=1e-9)


def test_weights_survive_their_file():
    weights = filters.packaged()
    again = filters.Weights.of(weights.document())
    assert again.document() == weights.document()
    assert weights.candidate.shape == (2, 1 + filters.terms(np.zeros((1, len(filters.FEATURES)))).shape[1])


def test_every_stage_can_be_looked_at():
    pictures = filters.stages(with_fruit(foliage(6), FRUIT))
    for name in (
        "balanced",
        "smooth",
        "red",
        "green",
        "highlight",
        "area_red",
        "circles_red",
        "combined_red",
        "combined_green",
    ):
        assert pictures[name].shape[:2] == (300, 400), name
    u, v, _ = (round(x * 400 / 640) for x in FRUIT[1])
    assert pictures["red"][v, u] > 0.5
    assert pictures["area_red"][v, u] == 1.0
    assert pictures["combined_red"][v, u] > 0.5
