"""The market's bench: its round is the machines' own, its rows hold together, and the services of it do each task once."""

import asyncio
from random import Random

import pytest

from core.allocation.bidding import Condition, Stop, offer, work_s
from core.wire.geometry import Point3, Pose2
from core.wire.market import Announcement, PlantCard
from lab.bench.clearing import clear
from lab.bench.market import crowd_rows, least_s, round_rows, service_rows
from lab.crowd import KIND, Instance, between_s

SEED = 5
ORIGIN = Point3(x_m=0.0, y_m=0.0, z_m=0.0)


def by_the_machines(instance):
    """The robots' queues when each plant in turn asks `bidding.offer` of each."""
    docks = {str(number): at for number, at in enumerate(instance.plants)}
    queues = [[] for _ in instance.starts]
    for plant in range(len(instance.plants)):
        card = PlantCard(
            plant_id=str(plant), url="http://x", stem=ORIGIN, dock=Pose2(x_m=0.0, y_m=0.0, yaw_rad=0.0), nozzle=ORIGIN
        )
        asked = Announcement(task_id=f"{plant}:1", kind=KIND, plant=card)
        offers = []
        for robot, queue in enumerate(queues):
            places = docks | {"here": instance.starts[robot]}
            stops = tuple(Stop(dock=str(q), work_s=work_s(KIND, 0.0), task_id=f"{q}:1") for q in queue)
            me = Condition(
                robot_id=f"{robot:03}", can=frozenset({KIND}), queue=stops,
                travel=lambda a, b, places=places: between_s(places[a], places[b]),
            )  # fmt: skip
            bid, at = offer(asked, me)
            offers.append((bid.cost_s, robot, at))
        _, robot, at = min(offers)
        queues[robot].insert(at, plant)
    return queues


@pytest.mark.parametrize("seed", [SEED, SEED + 1])
def test_the_compiled_round_gives_every_task_to_whom_the_machines_give_it(seed):
    print("seed", seed)
    instance = Instance.drawn(4, 40, Random(seed))
    assert clear(instance) == by_the_machines(instance)


def test_no_plan_takes_less_than_the_bound():
    print("seed", SEED)
    instance = Instance.drawn(3, 30, Random(SEED))
    queues = clear(instance)
    assert sorted(plant for queue in queues for plant in queue) == list(range(30))
    assert 0.6 < least_s(instance) / sum(instance.route_s(robot, queue) for robot, queue in enumerate(queues)) < 1.0


def test_the_rows_of_a_crowd_and_of_a_round_say_what_they_hold_themselves_to():
    rows = {row["name"]: row for row in (*crowd_rows(3, 12), *round_rows(3, 12, 1))}
    assert {name for name, row in rows.items() if "ok" in row and not row["ok"]} == set()
    assert rows["market/12x3 spread/served once"]["ours"] == rows["market/12x3 burst/served once"]["ours"] == 1.0
    assert rows["market/12x3 spread/award p99"]["target"] == 1.0
    assert rows["market/12x3 round, compiled"]["target"] == 0.5
    assert all(row["ratio"] > 1.0 for row in rows.values() if row["ratio"] is not None)


@pytest.mark.alone
def test_real_pots_and_robots_do_every_task_exactly_once():
    rows = {row["name"].rpartition("/")[2]: row for row in asyncio.run(service_rows(2, 4, rate=20.0))}
    assert rows["done exactly once"]["ok"], rows
    assert rows["award p99"]["ours"] < 2.0
    assert rows["messages"]["sent"]["scans"] == 4
