"""The best detector before the hand camera's frames of gardens that it has not learnt from."""

import numpy as np
import pytest

from core.perception.best import best_detector
from core.perception.detection import match, score, total
from lab.vision import dataset, rendered

SEED = 31
"""Not among those that were learnt from (docs/detectors.md)."""


@pytest.fixture(scope="module")
def judged():
    """(detections, boxes) of a few frames."""
    detect = best_detector()
    frames = list(rendered.frames(8, SEED))
    boxes = [[dataset.LabelBox.model_validate(box).box() for box in frame.labels["boxes"]] for frame in frames]
    return [(detect(frame.picture), here) for frame, here in zip(frames, boxes, strict=True)]


def test_it_finds_the_fruit_of_a_garden(judged):
    any_colour = total(score(found, boxes, None) for found, boxes in judged)
    assert any_colour.recall > 0.7, (SEED, any_colour)
    assert any_colour.precision > 0.7, (SEED, any_colour)


def test_what_it_calls_red_is_red(judged):
    red = total(score(found, boxes, "red") for found, boxes in judged)
    assert red.recall > 0.8, (SEED, red)
    assert red.precision > 0.7, (SEED, red)


def test_its_circles_fit_the_fruit(judged):
    off = []
    for found, boxes in judged:
        for detection, outcome in zip(found, match(found, boxes, [box.difficult for box in boxes]), strict=True):
            if outcome.box is not None and not outcome.ignored:
                box = boxes[outcome.box]
                off.append(detection.radius_px / (max(box.width_px, box.height_px) / 2))
    assert 0.8 < np.median(off) < 1.2, SEED
