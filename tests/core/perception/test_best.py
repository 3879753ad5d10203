"""The best detector: one network, read the same way every time."""

import importlib.resources
import socket

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from core.perception import best
from core.perception.detection import Detection


def maps_with(peaks, shape=(24, 32)):
    """Maps as the network gives them, empty but for (row, column, chance, width px, height px, colour)."""
    maps = np.zeros((best.OUTPUT_CHANNELS, *shape), np.float32)
    maps[0] = -10
    for row, column, chance, width, height, colour in peaks:
        maps[0, row, column] = np.log(chance / (1 - chance))
        maps[3:5, row, column] = np.log(np.array([width, height]) / best.SIZE_UNIT_PX)
        maps[5 + colour, row, column] = 5
    return maps


@pytest.fixture(scope="module")
def detect():
    return best.best_detector()


@pytest.fixture(scope="module")
def painted():
    """A dull green wall with four red balls, lit from above, at (u, v, radius) px."""
    balls = [(80, 70, 22), (230, 60, 30), (150, 160, 26), (270, 180, 16)]
    y, x = np.mgrid[0:240, 0:320].astype(np.float32)
    image = np.full((240, 320, 3), (60, 90, 70), np.float32)
    image += np.random.default_rng(4).normal(0, 6, (240, 320, 1)).astype(np.float32)
    for u, v, radius in balls:
        across, down = (x - u) / radius, (y - v) / radius
        inside = across**2 + down**2 < 1
        light = np.clip(0.45 + 0.55 * np.sqrt(np.clip(1 - across**2 - down**2, 0, 1)) - 0.3 * down, 0.1, 1.2)
        image[inside] = (np.array([25, 25, 200], np.float32) * light[..., None])[inside]
    return cv2.GaussianBlur(np.clip(image, 0, 255), (0, 0), 0.8).astype(np.uint8), balls


def test_a_peak_is_read_where_it_is_with_its_size_and_colour():
    boxes, confidences, colours = best.decode(maps_with([(3, 5, 0.8, 40, 20, 2), (20, 30, 0.6, 10, 12, 0)]))
    np.testing.assert_allclose(boxes, [[22, 14, 40, 20], [122, 82, 10, 12]], rtol=1e-5)
    fainter_green = 1 / (1 + (1 / 0.6 - 1) * np.exp(-best.COLOUR_LOGIT[0]))
    np.testing.assert_allclose(confidences, [0.8, fainter_green], rtol=1e-5)
    assert colours.tolist() == [2, 0]


def test_a_cell_below_the_least_confidence_is_no_peak():
    assert len(best.decode(maps_with([(3, 5, 0.2, 40, 20, 2)]), 0.3)[0]) == 0


def test_two_boxes_on_one_fruit_are_one_and_neighbours_stay_two():
    boxes = np.array([[50, 50, 40, 40], [55, 50, 40, 40], [90, 50, 40, 40]], np.float32)
    assert best.distinct(boxes, np.array([0.5, 0.9, 0.4], np.float32)) == [1, 2]


@given(st.floats(0.2, 1.0), st.floats(0.2, 1.0), st.floats(0.2, 1.0))
def test_the_balanced_planes_hardly_change_with_the_lamp(blue, green, red):
    image = np.random.default_rng(1).uniform(60, 250, (16, 16, 3))
    under_lamp = (image * [blue, green, red]).round().astype(np.uint8)
    daylight = best.planes(image.round().astype(np.uint8))[3:]
    np.testing.assert_allclose(best.planes(under_lamp)[3:], daylight, atol=0.05)


@pytest.mark.parametrize("scale", [0.5, 1.0, 2.0, 3.7])
def test_found_circles_are_given_in_the_pixels_of_the_image_as_it_came(scale):
    image = np.zeros((round(96 * scale), round(128 * scale), 3), np.uint8)
    grid = (best.LONG_SIDE_PX * 3 // 4 // 4, best.LONG_SIDE_PX // 4)
    (found,) = best.detect(image, lambda planes: maps_with([(47, 63, 0.9, 64, 64, 2)], grid))
    unit = 128 * scale / best.LONG_SIDE_PX
    expected = Detection(u_px=254 * unit, v_px=190 * unit, radius_px=32 * unit, colour="red", confidence=0.9)
    assert found.colour == expected.colour
    assert (found.u_px, found.v_px, found.radius_px) == pytest.approx(
        (expected.u_px, expected.v_px, expected.radius_px), rel=0.02
    )


def test_it_opens_without_a_network(monkeypatch):
    def refuse(*args, **kwargs):
        raise AssertionError("a detector reaches for nothing outside its package")

    monkeypatch.setattr(socket, "socket", refuse)
    monkeypatch.setattr(socket, "create_connection", refuse)
    best.best_detector()


def test_the_packaged_weights_stay_small():
    weights = importlib.resources.files("core.perception").joinpath(best.WEIGHTS).read_bytes()
    assert len(weights) < 2_000_000


def test_the_same_image_gives_the_same_fruit_and_stays_as_it_was(detect, painted):
    image, _ = painted
    before = image.copy()
    other = np.random.default_rng(3).integers(0, 256, (300, 200, 3), np.uint8)
    first = detect(image)
    detect(other)
    assert detect(image) == first
    assert best.best_detector()(image) == first
    np.testing.assert_array_equal(image, before)


def test_red_balls_before_a_wall_are_found_as_red_fruit_of_their_size(detect, painted):
    image, balls = painted
    found = detect(image)
    for u, v, radius in balls:
        near = [d for d in found if np.hypot(d.u_px - u, d.v_px - v) < radius / 2]
        assert [d.colour for d in near] == ["red"], (u, v)
        assert near[0].radius_px == pytest.approx(radius, rel=0.3)


@pytest.mark.parametrize("shape", [(240, 320), (480, 640), (500, 400), (31, 700), (1, 1)])
def test_any_shape_of_image_is_answered(detect, shape):
    for d in detect(np.full((*shape, 3), 90, np.uint8)):
        assert 0 <= d.u_px < shape[1]
        assert 0 <= d.v_px < shape[0]


def test_black_and_white_frames_hold_no_fruit(detect):
    assert detect(np.zeros((240, 320, 3), np.uint8)) == []
    assert detect(np.full((240, 320, 3), 255, np.uint8)) == []
