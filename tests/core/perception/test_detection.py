"""How detections are matched with labelled boxes and counted."""

import math

import pytest

from core.errors import ConfigError
from core.perception.detection import Box, Counts, Detection, match, score, total
from core.perception.registry import detector, keen_detectors


def at(u, v, colour="red", confidence=0.9):
    return Detection(u_px=u, v_px=v, radius_px=5.0, colour=colour, confidence=confidence)


def box(x, y, label="red", size=10.0, difficult=False):
    return Box(x_px=x, y_px=y, width_px=size, height_px=size, label=label, difficult=difficult)


def nothing(image):
    return []


def test_a_centre_inside_the_box_finds_it_and_one_outside_is_false():
    assert score([at(5, 5), at(10.5, 5)], [box(0, 0)], "red") == Counts(found=1, false=1, missed=0)


def test_a_box_is_found_once():
    assert score([at(4, 5), at(6, 5)], [box(0, 0)], "red") == Counts(1, 1, 0)


def test_the_surer_of_two_takes_the_box_and_the_other_the_next():
    outcome = match([at(8, 5, confidence=0.5), at(6, 5, confidence=0.9)], [box(0, 0), box(4, 0)], [False, False])
    assert [o.box for o in outcome] == [1, 0]


def test_a_difficult_box_counts_neither_when_found_nor_when_missed():
    hard = box(0, 0, difficult=True)
    assert score([at(5, 5), at(6, 6)], [hard], "red") == Counts()
    assert score([], [hard], "red") == Counts()
    assert score([at(5, 5)], [hard], None) == Counts()


def test_a_fruit_that_is_not_difficult_is_found_under_one_that_is():
    assert score([at(5, 5)], [box(0, 0, difficult=True), box(0, 0)], "red") == Counts(1, 0, 0)


def test_turning_fruit_count_neither_for_nor_against_red_but_are_fruit():
    assert score([at(5, 5)], [box(0, 0, "turning")], "red") == Counts()
    assert score([], [box(0, 0, "turning")], "red") == Counts()
    assert score([at(5, 5)], [box(0, 0, "turning")], None) == Counts(1, 0, 0)
    assert score([], [box(0, 0, "turning")], None) == Counts(0, 0, 1)


def test_a_red_detection_on_a_green_fruit_is_false_for_red_and_right_for_any_fruit():
    assert score([at(5, 5)], [box(0, 0, "green")], "red") == Counts(0, 1, 0)
    assert score([at(5, 5)], [box(0, 0, "green")], "green") == Counts(0, 0, 1)
    assert score([at(5, 5)], [box(0, 0, "green")], None) == Counts(1, 0, 0)


def test_counts_add_up_to_precision_recall_and_f1():
    sum_ = total([Counts(3, 1, 0), Counts(1, 0, 4)])
    assert (sum_.precision, sum_.recall) == (4 / 5, 4 / 8)
    assert sum_.f1 == pytest.approx(2 * 0.8 * 0.5 / 1.3)


def test_nothing_to_find_and_nothing_found_is_no_number():
    assert all(math.isnan(x) for x in (Counts().precision, Counts().recall, Counts().f1))


def test_a_user_brings_a_detector_by_its_name():
    assert detector(f"{__name__}:nothing") is nothing


@pytest.mark.parametrize("name", ["perfect", "no.such.module:f", "core.perception.detection:no_such_function"])
def test_an_unknown_detector_is_refused_with_what_would_work(name):
    with pytest.raises(ConfigError) as refused:
        detector(name)
    assert refused.value.hint


def test_only_a_detector_that_tells_of_faint_circles_says_which_stand_for_themselves() -> None:
    *_, sure_min = keen_detectors("best")
    assert 0.0 < sure_min < 1.0
    assert keen_detectors("filter")[2] == 0.0
