"""Rounds of bids that one plant has open at the same time are bounded, and the urgent come first."""

from core.allocation.plant_side import Market
from core.allocation.plant_state import Limits, Rules, Solicit
from core.wire.fruit import Fruit
from core.wire.geometry import Point3, Pose2
from core.wire.market import Bid, PlantCard, Report

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


def harvests(made, count, now_s):
    """So many more, each for a fruit of its own; what is asked at once."""
    for number in range(count):
        made.ask("harvest", 0.0, "operator", "", now_s, fruit_ids=[f"plant-1:f{number + int(100 * now_s)}"], count=1)
    return asked(made, now_s)


def test_of_rounds_that_began_one_after_the_other_the_first_to_end_makes_room():
    made = market(0)
    made.fruits([fruit(number) for number in range(200)], 0.0)
    for number in range(BOUND):
        assert len(harvests(made, 1, 0.1 * number)) == 1
    assert harvests(made, 1, 0.1 * BOUND) == []
    assert made.due_s() == Rules().bid_window_s, "when the first ends, not the last"
    (late,) = asked(made, made.due_s())
    assert late.announcement.task_id.endswith(str(BOUND + 1))


def test_a_task_that_was_cancelled_makes_room_at_once():
    made = market(BOUND + 1)
    first = asked(made, 0.0)
    made.cancel(first[0].announcement.task_id, "operator", "", 0.5)
    made.take_effects()
    assert made.due_s() <= 0.5
    assert len(asked(made, 0.5)) == 1


def test_a_holder_is_asked_for_its_price_only_when_there_is_room_for_a_round():
    made, rules = market(0), Rules()
    made.fruits([fruit(number) for number in range(2000)], 0.0)
    task_id = made.ask("inventory", 0.0, "operator", "", 0.0).task_id
    (ask,) = asked(made, 0.0)
    for robot_id in ROBOTS:
        bid = Bid(task_id=task_id, robot_id=robot_id, cost_s=9.0)
        made.bid(task_id, ask.round_number, robot_id, bid, 0.0)
    begun_s = rules.reallocate_s - 0.5
    for now_s in (5.0, begun_s):
        made.report(task_id, Report(robot_id="robot-1", epoch=1, state="awarded"), now_s)
    assert len(harvests(made, BOUND, begun_s)) == BOUND
    assert asked(made, rules.reallocate_s) == []
    assert made.due_s() == begun_s + rules.bid_window_s
    assert [ask.announcement.holder for ask in asked(made, made.due_s())][:1] == ["robot-1"]
