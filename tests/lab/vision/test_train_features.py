"""Learning the feature detector: places, stumps, boosting."""

import numpy as np
import pytest

from core.perception import features
from core.perception.detection import Box
from lab.vision import train_features
from lab.vision.train_features import Dictionary, Samples, Scene

BOX = Box(x_px=80, y_px=60, width_px=40, height_px=40, label="red")


def hidden(box):
    return Box(x_px=box.x_px, y_px=box.y_px, width_px=box.width_px, height_px=box.height_px, label=box.label, difficult=True)


@pytest.mark.parametrize(
    ("circle", "boxes", "expected"),
    [
        ((100, 80, 20), [BOX], 1),
        ((103, 80, 22), [BOX], 1),
        ((100, 80, 8), [BOX], -1),
        ((112, 80, 20), [BOX], 0),
        ((119, 80, 20), [BOX], -1),
        ((10, 10, 20), [BOX], -1),
        ((100, 80, 20), [hidden(BOX)], 0),
        ((119, 80, 20), [hidden(BOX)], 0),
    ],
)
def test_a_place_is_fruit_when_it_fits_a_box_and_background_when_it_does_not(circle, boxes, expected):
    assert train_features.verdict(circle, boxes) == expected


def samples_split_by(column, columns=7, count=400):
    """Bins that say nothing, but for one column that is high on fruit."""
    rng = np.random.default_rng(11)
    target = np.where(np.arange(count) % 4 == 0, 1, -1).astype(np.float32)
    bins = rng.integers(0, features.BINS, (count, columns)).astype(np.uint8)
    bins[:, column] = np.where(target > 0, rng.integers(40, 64, count), rng.integers(0, 40, count))
    return Samples(bins, target, np.full(count, "here"))


def test_a_stump_takes_the_column_that_tells_and_cuts_where_it_tells():
    samples = samples_split_by(4)
    column, table = train_features.stump(samples.bins, np.full(400, 1 / 400, np.float32), samples.target)
    assert column == 4
    assert table[:40] == pytest.approx(-1, abs=0.1)
    assert table[40:] == pytest.approx(1, abs=0.1)


def test_boosting_takes_the_telling_patch_first_and_stays_with_so_many(monkeypatch):
    monkeypatch.setattr(train_features, "STRONGEST", 3)
    monkeypatch.setattr(train_features, "STUMPS", 12)
    samples = samples_split_by(5)
    samples.target[::11] *= -1
    places = np.column_stack([np.zeros((7, 3)), np.arange(7), np.zeros(7)]).astype(np.int32)
    dictionary = Dictionary(places, np.zeros((7, *features.PATCH_SHAPE), np.float32))
    model = train_features.boosted(samples, dictionary, lambda _: None)
    assert model.features[0, 3] == 5
    assert len(model.features) == 3
    margin = sum(table[samples.bins[:, f[3]]] for table, f in zip(model.tables, model.features, strict=True))
    assert ((margin > 0) == (samples.target > 0)).mean() > 0.88


def test_the_cascade_gives_up_hardly_any_fruit_that_would_be_found():
    rng = np.random.default_rng(2)
    steps = np.cumsum(rng.normal(0.2, 0.5, (1000, 40)), axis=1).astype(np.float32)
    nothing = np.zeros((40, 1), np.float32)
    blank = features.Model(
        features=np.zeros((40, 5), np.int32),
        patches=nothing,
        tables=nothing,
        floors=nothing[:, 0],
        margin_min=nothing[0],
        slope=nothing[:2, 0],
        colour=nothing,
    )
    model = train_features.with_floors(blank, steps, 4.0)
    found = steps[:, -1] >= 4.0
    assert (steps[found] >= model.floors).all(axis=1).mean() > 0.75
    assert (steps[~found] >= model.floors).all(axis=1).mean() == 0


def test_the_same_seed_draws_the_same_patches_from_fruit():
    rng = np.random.default_rng(8)
    scenes = [Scene("a", f"a/{k}", (BOX,), rng.integers(0, 256, (160, 200, 3), dtype=np.uint8)) for k in range(2)]
    one, again = (train_features.drawn(scenes, 6, np.random.default_rng(1)) for _ in range(2))
    np.testing.assert_array_equal(one.patches, again.patches)
    np.testing.assert_array_equal(one.features, again.features)
    for patch, feature in zip(one.patches, one.features, strict=True):
        assert np.linalg.norm(patch) == pytest.approx(1, abs=1e-5)
        assert patch[: feature[2], : feature[2]].sum() == pytest.approx(0, abs=1e-4)


def test_a_mirrored_scene_mirrored_is_the_scene():
    image = np.random.default_rng(1).integers(0, 256, (30, 40, 3), dtype=np.uint8)
    one = Scene("a", "a/1", (BOX,), image)
    twice = train_features.mirrored(train_features.mirrored(one))
    assert twice.boxes == one.boxes
    np.testing.assert_array_equal(twice.image, one.image)
