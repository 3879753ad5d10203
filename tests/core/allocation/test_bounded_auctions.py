"""Rounds of bids that one plant has open at the same time are bounded, and the urgent come first."""

from core.allocation.plant_side import Market
from core.allocation.plant_state import Limits, Rules, Solicit
from core.wire.fruit import Fruit
from core.wire.geometry import Point3, Pose2
from core.wire.market import Bid, PlantCard

ORIGIN = Point3(x_m=0.0, y_m=0.0, z_m=0.0)
CARD = PlantCard(
    plant_id="plant-1", url="http://plant-1", stem=ORIGIN, dock=Pose2(x_m=0.0, y_m=0.0, yaw_rad=0.0), nozzle=ORIGIN
)
ROBOTS = ("robot-1", "robot-2")
BOUND = Rules().auctions_max


def market(tasks):
    """A plant with so many open harvests, the later the more urgent."""
    made = Market(CARD, None, 0.0, Rules(), Limits())
    fruits = [fruit(number) for number in range(tasks)]
    made.fruits(fruits, 0.0)
    for number in range(tasks):
        made.ask("harvest", 0.0, "operator", "", 0.0, priority=number % 10, fruit_ids=[fruits[number].fruit_id], count=1)
    made.take_effects()
    return made


def fruit(number):
    return Fruit(
        fruit_id=f"plant-1:f{number}", colour="red", x_m=0.1, y_m=0.0, z_m=0.3, radius_m=0.014, confidence=0.9,
        first_seen_s=0.0, last_seen_s=0.0,
    )  # fmt: skip


def asked(made, now_s):
    made.tick(now_s, ROBOTS)
    return [effect for effect in made.take_effects() if isinstance(effect, Solicit)]


def answer(made, ask, now_s):
    for robot_id in ROBOTS:
        bid = Bid(task_id=ask.announcement.task_id, robot_id=robot_id, cost_s=None, reason="stopped")
        made.bid(ask.announcement.task_id, ask.round_number, robot_id, bid, now_s)


def test_no_more_rounds_than_allowed_are_open_and_the_most_urgent_are():
    made = market(9)
    first = asked(made, 0.0)
    assert [ask.announcement.priority for ask in first] == [8, 7, 6, 5][:BOUND]
    assert asked(made, 0.1) == []
    assert made.due_s() == Rules().bid_window_s, "nothing to do before a round ends"


def test_a_round_that_ends_makes_room_for_the_next():
    made = market(9)
    first = asked(made, 0.0)
    answer(made, first[0], 0.5)
    made.take_effects()
    assert made.due_s() <= 0.5, "at once"
    assert [ask.announcement.priority for ask in asked(made, 0.5)] == [8 - BOUND]


def test_silent_robots_hold_no_round_open_for_ever_and_every_task_has_its_turn():
    made = market(9)
    turns, now_s = [], 0.0
    while now_s < 30.0 and len(set(turns)) < 9:
        turns += [ask.announcement.task_id for ask in asked(made, now_s)]
        now_s = max(now_s + 0.01, made.due_s())
    assert len(set(turns)) == 9
