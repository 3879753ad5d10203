"""Whole markets without bodies, their costs beside an optimum, and the paper's figure 13."""

from random import Random

import pytest

from core.allocation.bidding import price
from lab.crowd import Crowd, Instance
from lab.experiments.allocation import FIG13, compared, fig13

SEED = 4


def outcome(robots, plants, seed=SEED):
    instance = Instance.drawn(robots, plants, Random(seed))
    return instance, Crowd(instance, Random(seed)).run()


def test_the_trace_of_figure_13_is_ours():
    assert fig13() == FIG13


def test_every_plant_of_a_crowd_is_served_once_and_the_seconds_add_up():
    print("seed", SEED)
    instance, served = outcome(3, 12)
    assert sorted(plant for route in served.routes for plant in route) == list(range(12))
    by_hand = [instance.route_s(robot, plants) for robot, plants in enumerate(served.routes)]
    assert served.busy_s == pytest.approx(by_hand)
    assert served.makespan_s <= max(by_hand) + 21.0
    assert len(served.award_s) == 12
    assert max(served.award_s) < 0.1


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_burst_is_shared_out_as_well_as_wishes_that_come_one_after_another(seed):
    print("seed", seed)
    instance = Instance.drawn(4, 20, Random(seed))
    spread = Crowd(instance, Random(seed), together_s=20.0).run()
    burst = Crowd(instance, Random(seed), together_s=0.0).run()
    assert burst.declines > 0
    assert burst.makespan_s <= 1.15 * spread.makespan_s
    assert sum(burst.busy_s) <= 1.1 * sum(spread.busy_s)
    assert max(burst.award_s) < 3.0


def test_a_crowd_is_a_function_of_its_seed():
    assert outcome(2, 6)[1] == outcome(2, 6)[1]


def test_no_plan_that_is_searched_from_ours_is_worse_than_ours():
    pytest.importorskip("ortools")
    total_ratio, span_ratio = compared(Instance.drawn(2, 4, Random(SEED)), SEED, price)
    assert 1.0 - 1e-3 <= total_ratio < 1.5
    assert 1.0 - 1e-3 <= span_ratio < 1.6
