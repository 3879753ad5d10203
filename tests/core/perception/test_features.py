"""The feature detector: patches that vote for a fruit's centre, whatever its colour."""

import importlib.resources
from dataclasses import replace

import cv2
import numpy as np
import pytest

from core.perception import feature_kernels, features


@pytest.fixture(scope="module")
def model():
    return features.packaged()


@pytest.fixture(scope="module")
def level():
    rng = np.random.default_rng(3)
    image = cv2.GaussianBlur(rng.integers(0, 256, (120, 160, 3), dtype=np.uint8), (0, 0), 2)
    return next(features.levels(cv2.normalize(image, None, 0, 255, cv2.NORM_MINMAX)))


@pytest.fixture(scope="module")
def painted():
    """A dull wall with four red balls, lit from above, at (u, v, radius) px."""
    balls = [(80, 70, 22), (230, 60, 30), (150, 160, 26), (270, 180, 16)]
    y, x = np.mgrid[0:240, 0:320].astype(np.float32)
    image = np.full((240, 320, 3), (40, 60, 50), np.float32)
    image += np.random.default_rng(4).normal(0, 4, (240, 320, 1)).astype(np.float32)
    for u, v, radius in balls:
        across, down = (x - u) / radius, (y - v) / radius
        inside = across**2 + down**2 < 1
        light = np.clip(0.45 + 0.55 * np.sqrt(np.clip(1 - across**2 - down**2, 0, 1)) - 0.3 * down, 0.1, 1.2)
        image[inside] = (np.array([60, 70, 220], np.float32) * light[..., None])[inside]
    return cv2.GaussianBlur(np.clip(image, 0, 255), (0, 0), 0.8).astype(np.uint8), balls


def feature(plane, which, right, down):
    return np.array([plane, which, features.SIZES[which], right, down], np.int32)


def patch_at(level, plane, which, x, y):
    half = features.SIZES[which] // 2
    cut = level.planes[plane, y - half : y + half + 1, x - half : x + half + 1]
    patch = np.zeros(features.PATCH_SHAPE, np.float32)
    patch[: cut.shape[0], : cut.shape[1]] = (cut - cut.mean()) / np.linalg.norm(cut - cut.mean())
    return patch


@pytest.mark.parametrize("which", range(len(features.SIZES)))
def test_a_patch_correlates_fully_with_where_it_was_cut_and_nowhere_more(level, which, monkeypatch):
    monkeypatch.setattr(features, "NOISE", 1e-4)
    monkeypatch.setattr(features, "mask", lambda: np.array([1.0], np.float32))
    sharp = replace(level, weights=features.norms_of(level.planes))
    votes = features.votes_of(sharp, feature(0, which, 0, 0), patch_at(level, 0, which, 90, 70))
    assert votes[70, 90] == pytest.approx(1, abs=2e-3)
    assert votes.max() <= 1.01
    template = cv2.matchTemplate(
        level.planes[0], patch_at(level, 0, which, 90, 70)[(slice(features.SIZES[which]),) * 2], cv2.TM_CCOEFF_NORMED
    )
    half = features.SIZES[which] // 2
    inner = (slice(20, -20),) * 2
    structured = sharp.weights[0, which, half:-half, half:-half][inner] < 1 / (features.SIZES[which] * 0.01)
    assert structured.mean() > 0.2
    there = votes[half:-half, half:-half][inner][structured]
    np.testing.assert_allclose(there, template[inner][structured], atol=5e-3)


@pytest.mark.parametrize("which", range(len(features.SIZES)))
def test_a_feature_says_the_same_at_a_point_as_in_its_map(level, which):
    one, patch = feature(2, which, 5, -3), patch_at(level, 2, which, 80, 60)
    votes = features.votes_of(level, one, patch)
    for x, y in ((60, 50), (100, 80)):
        lanes = np.zeros(feature_kernels.WIDE, np.float32)
        said = feature_kernels.vote(level.planes, level.weights, x, y, one, patch, features.mask(), lanes)
        assert said == pytest.approx(votes[y - 3, x + 5], abs=1e-4)


def test_a_cascade_that_gives_nothing_up_ends_at_the_vote_map(level, model):
    points = np.array([[50, 60], [120, 90], [77, 33]], np.int32)
    never = replace(model, floors=np.full(len(model.floors), -1e6, np.float32))
    margins = np.zeros(len(points), np.float32)
    learnt = (never.features, never.patches, features.mask(), never.tables, never.floors)
    feature_kernels.cascade(level.planes, level.weights, points, *learnt, 0, margins)
    everywhere = features.vote_map(level, never, len(never.features))
    np.testing.assert_allclose(margins, everywhere[points[:, 1], points[:, 0]], atol=0.3)


def test_a_point_that_falls_below_a_floor_is_given_up(level, model):
    strict = replace(model, floors=np.full(len(model.floors), 1e6, np.float32))
    margins = np.zeros(1, np.float32)
    learnt = (strict.features, strict.patches, features.mask(), strict.tables, strict.floors)
    feature_kernels.cascade(level.planes, level.weights, np.array([[60, 60]], np.int32), *learnt, 0, margins)
    assert margins[0] == feature_kernels.GIVEN_UP


def test_balls_are_found_where_they_are(painted):
    image, balls = painted
    found = features.features_detector()(image)
    hit = sum(
        any(np.hypot(d.u_px - u, d.v_px - v) < r / 2 and 0.5 < d.radius_px / r < 2 for d in found) for u, v, r in balls
    )
    assert hit >= 3
    assert all(0 < d.confidence < 1 for d in found)
    assert [d.confidence for d in found] == sorted((d.confidence for d in found), reverse=True)


@pytest.mark.parametrize("channels", [(0, 2, 1), (2, 1, 0), (1, 2, 0)])
def test_fruit_are_found_whatever_their_colour(painted, model, channels):
    image, _ = painted
    other = np.ascontiguousarray(image[:, :, list(channels)])
    np.testing.assert_allclose(features.found(other, model)[0], features.found(image, model)[0])


def test_there_is_nothing_to_see_in_a_black_image(model):
    assert features.detect(np.zeros((48, 64, 3), np.uint8), model) == []


@pytest.mark.parametrize("shape", [(1, 1), (3, 200), (200, 3)])
def test_an_image_of_any_shape_is_looked_at(shape, model):
    features.detect(np.full((*shape, 3), 128, np.uint8), model)


def test_the_packaged_model_is_forty_patches_in_fifteen_scales_and_small(model):
    assert len(model.features) == 40
    assert features.SCALES == 15
    packaged = importlib.resources.files("core.perception").joinpath(features.WEIGHTS)
    assert len(packaged.read_bytes()) < 300_000


def test_no_patch_reaches_beyond_the_border(model):
    reach = np.abs(model.features[:, 3:]).max(axis=1) + model.features[:, 2] // 2 + features.MASK_REACH
    assert reach.max() <= features.BORDER_PX


def test_a_model_comes_back_from_its_file_and_another_version_is_refused(model, monkeypatch):
    written = model.to_bytes()
    again = features.Model.of(written)
    np.testing.assert_array_equal(again.patches, model.patches)
    np.testing.assert_array_equal(again.tables, model.tables)
    monkeypatch.setattr(features, "VERSION", features.VERSION + 1)
    with pytest.raises(ValueError, match="garden train features"):
        features.Model.of(written)
