"""Labelled images made into many: the labels stay with the fruit."""

import importlib
import sys

import cv2
import numpy as np
import pytest

from core.errors import ConfigError
from core.perception.detection import Box
from lab.vision import augment

SEEDS = range(12)


def bright_discs(size=(600, 800)):
    """Ten discs, each of a brightness of its own, on black; all labelled."""
    image = np.zeros((*size, 3), np.uint8)
    boxes = []
    for k in range(10):
        u, v, radius = 80 + 160 * (k % 5), 150 + 300 * (k // 5), 30 + 4 * k
        cv2.circle(image, (u, v), radius, (255, 255, 255), -1, cv2.LINE_AA)
        boxes.append(Box(x_px=u - radius, y_px=v - radius, width_px=2 * radius, height_px=2 * radius, label="red"))
    return image, boxes


@pytest.fixture(scope="module")
def discs():
    return augment.scene(*bright_discs(), trust=1.0, trust_ambiguous=0.3)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_cut_scaled_turned_or_mirrored_takes_its_boxes_along(discs, seed):
    cut = augment.cut(discs, np.random.default_rng(seed))
    assert cut.image.shape == (augment.SIDE_PX, augment.SIDE_PX, 3)
    whole = [
        box for box in cut.boxes if (box[:2] - box[2:] / 2 > 1).all() and (box[:2] + box[2:] / 2 < augment.SIDE_PX - 1).all()
    ]
    for u, v, w, h in whole:
        left, top, right, bottom = (round(x) for x in (u - w / 2, v - h / 2, u + w / 2, v + h / 2))
        y, x = np.nonzero(cut.image[top:bottom, left:right, 1] > 127)
        assert (left + x.mean() + 0.5, top + y.mean() + 0.5) == pytest.approx((u, v), abs=1.0 + w / 40), seed
        assert np.ptp(x) + 1 == pytest.approx(w, abs=2 + w / 15), seed


def test_some_square_shows_a_whole_fruit(discs):
    cuts = [augment.cut(discs, np.random.default_rng(seed)) for seed in SEEDS]
    assert sum(len(cut.boxes) for cut in cuts) > len(SEEDS)


def test_a_pasted_fruit_is_labelled_and_what_it_hides_is_not_counted(discs):
    rng = np.random.default_rng(5)
    base = augment.cut(discs, rng)
    more = augment.with_fruit_of(discs, base, rng)
    assert not np.array_equal(more.image, base.image)
    box = more.boxes[-1]
    assert more.counted[-1]
    hidden = augment.hidden_share(more.boxes[:-1], box)
    assert not more.counted[:-1][hidden > 0.6].any()


@pytest.mark.parametrize("seed", SEEDS)
def test_another_lamp_and_lens_leave_an_image(seed):
    image = np.random.default_rng(seed).integers(0, 256, (augment.SIDE_PX, augment.SIDE_PX, 3), np.uint8)
    relit = augment.relit(image, np.random.default_rng(seed))
    assert relit.dtype == np.uint8
    assert relit.shape == image.shape
    assert relit.std() > 2, seed


def test_the_same_seed_gives_the_same_square(discs):
    first, second = (augment.sample([discs], np.ones(1), np.random.default_rng(3)) for _ in range(2))
    np.testing.assert_array_equal(first.image, second.image)
    np.testing.assert_array_equal(first.boxes, second.boxes)


def test_an_ambiguous_colour_is_believed_less():
    box = Box(x_px=0, y_px=0, width_px=9, height_px=9, label="green", ambiguous=True)
    assert augment.scene(np.zeros((20, 20, 3), np.uint8), [box], 0.8, 0.1).trust.tolist() == pytest.approx([0.1])


def test_training_without_torch_names_the_extra(monkeypatch):
    monkeypatch.delitem(sys.modules, "lab.vision.train_best", raising=False)
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(ConfigError) as refusal:
        importlib.import_module("lab.vision.train_best")
    assert "--extra train" in refusal.value.hint
