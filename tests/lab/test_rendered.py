"""Rendered frames say truly what is in them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from lab.vision import dataset
from lab.vision.rendered import Frame, frames, write

COUNT, SEED = 4, 3


@pytest.fixture(scope="module")
def some() -> list[Frame]:
    return list(frames(COUNT, SEED))


def test_the_same_seed_gives_the_same_frames_and_another_others(some: list[Frame]) -> None:
    again = list(frames(COUNT, SEED))
    assert all((a.picture == b.picture).all() and a.labels == b.labels for a, b in zip(some, again, strict=True))
    assert next(frames(1, SEED + 1)).labels != some[0].labels


def test_a_labelled_red_fruit_is_red_where_its_circle_is(some: list[Frame]) -> None:
    told = []
    for frame in some:
        for box in frame.labels["boxes"]:
            if box["label"] == "red" and box["visible_ratio"] > 0.7 and "difficult" not in box:
                mask = np.zeros(frame.picture.shape[:2], np.uint8)
                cv2.circle(mask, (round(box["u"]), round(box["v"])), max(1, round(0.6 * box["radius"])), 255, -1)
                blue, green, red, _ = cv2.mean(frame.picture, mask)
                told.append(red > 1.3 * max(green, blue))
    assert len(told) >= 3
    assert np.mean(told) >= 0.9


def test_boxes_lie_in_the_picture_and_hold_their_circles_middle_unless_it_is_outside(some: list[Frame]) -> None:
    for frame in some:
        width, height = frame.labels["width"], frame.labels["height"]
        assert frame.picture.shape == (height, width, 3)
        for box in frame.labels["boxes"]:
            assert 0 <= box["x"] <= box["x"] + box["w"] <= width + 0.01
            assert 0 <= box["y"] <= box["y"] + box["h"] <= height + 0.01
            assert 0.02 <= box["visible_ratio"] <= 1
            assert ("difficult" in box) == (box["visible_ratio"] < 0.4 or box["radius"] < 0.012 * width)


def test_written_frames_are_read_back_by_the_dataset(tmp_path) -> None:  # type: ignore[no-untyped-def]
    count = write(tmp_path, 2, SEED)
    photographs = dataset.read(tmp_path)
    assert len(photographs) == 2
    assert photographs[0].group == photographs[1].group
    assert sum(not box.difficult for photograph in photographs for box in photograph.boxes) == count
    assert photographs[0].image().ndim == 3
