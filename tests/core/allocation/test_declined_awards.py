"""Awards that come too late for their bid: declined, asked again at once, bounded, and nobody's failure."""

from core.allocation.auction import worth_s
from core.allocation.plant_side import Market
from core.allocation.plant_state import Grant, Kill, Limits, Rules, Solicit
from core.wire.geometry import Point3, Pose2
from core.wire.market import Bid, PlantCard, Report

ORIGIN = Point3(x_m=0.0, y_m=0.0, z_m=0.0)
CARD = PlantCard(
    plant_id="plant-1", url="http://plant-1", stem=ORIGIN, dock=Pose2(x_m=0.0, y_m=0.0, yaw_rad=0.0), nozzle=ORIGIN
)
RULES = Rules()


def bid(robot_id, cost_s, task_id="t"):
    return Bid(task_id=task_id, robot_id=robot_id, cost_s=cost_s)


class Play:
    """One plant's market, and what its robots would bid."""

    def __init__(self, **costs_s):
        self.now_s, self.costs_s = 0.0, costs_s
        self.market = Market(CARD, None, 0.0, RULES, Limits())
        self.market.soil(0.1, "", 0.0)
        self.task_id = self.market.ask("water", 150.0, "soil", "dry", 0.0).task_id
        self.killed: list[str] = []

    @property
    def task(self):
        return self.market.task(self.task_id)

    def award(self):
        """Let time pass until an award leaves; returns it."""
        while True:
            self.market.tick(self.now_s, tuple(self.costs_s))
            for effect in self.market.take_effects():
                if isinstance(effect, Kill):
                    self.killed.append(effect.robot_id)
                if isinstance(effect, Grant):
                    return effect
                if isinstance(effect, Solicit):
                    for robot_id in effect.robots:
                        answer = bid(robot_id, self.costs_s[robot_id], self.task_id)
                        self.market.bid(self.task_id, effect.round_number, robot_id, answer, self.now_s)
                    break
            else:
                self.now_s = max(self.now_s, self.market.due_s())

    def decline(self, grant):
        self.market.award_answered(self.task_id, grant.award.epoch, "90 s by now", self.now_s, overtaken=True)


def test_a_price_holds_up_to_the_next_cheapest_and_at_least_a_margin():
    assert worth_s([bid("a", 10.0), bid("b", 30.0)], bid("a", 10.0), 0.2) == 30.0
    assert worth_s([bid("a", 10.0), bid("b", 11.0), bid("c", 30.0)], bid("a", 10.0), 0.2) == 12.0
    assert worth_s([bid("a", 10.0), bid("b", None)], bid("a", 10.0), 0.2) is None


def test_an_award_says_up_to_what_price_it_is_meant():
    assert Play(a=10.0, b=30.0).award().award.at_most_s == 30.0
    assert Play(a=10.0).award().award.at_most_s is None


def test_a_declined_award_is_asked_again_within_a_tenth_of_a_second_and_is_no_failure():
    play = Play(a=10.0, b=30.0)
    play.decline(play.award())
    assert play.task.state == "announced"
    assert "a declined the award: 90 s by now" in play.task.reason
    play.costs_s["a"] = 90.0
    second = play.award()
    assert (second.robot_id, second.award.epoch) == ("b", 2)
    assert play.now_s < 0.1
    assert play.market.document().failures.get(play.task_id, 0) == 0


def test_whoever_is_always_too_late_gets_its_robot_in_the_end():
    play = Play(a=10.0, b=30.0)
    for number in range(RULES.declines_max):
        grant = play.award()
        assert grant.award.at_most_s is not None, number
        play.decline(grant)
    assert play.award().award.at_most_s is None
    assert play.now_s < 10.0
    assert play.task.state == "awarded"


def test_a_task_that_moved_and_was_declined_does_not_move_for_a_price_again():
    play = Play(a=10.0, b=30.0)
    first = play.award()
    play.market.award_answered(play.task_id, first.award.epoch, "", play.now_s)
    play.costs_s |= {"a": 50.0, "b": 20.0}
    play.now_s = RULES.reallocate_s + 1.0
    play.market.report(play.task_id, Report(robot_id="a", epoch=1, state="awarded"), play.now_s)
    moved = play.award()
    assert (moved.robot_id, play.killed) == ("b", ["a"])
    play.decline(moved)
    third = play.award()
    play.market.award_answered(play.task_id, third.award.epoch, "", play.now_s)
    play.costs_s |= {third.robot_id: 500.0}
    play.now_s += RULES.reallocate_s + 1.0
    play.market.report(play.task_id, Report(robot_id=third.robot_id, epoch=3, state="awarded"), play.now_s)
    for _ in range(4):
        play.market.tick(play.now_s, tuple(play.costs_s))
        for effect in play.market.take_effects():
            assert not isinstance(effect, Grant | Kill)
            if isinstance(effect, Solicit):
                for robot_id in effect.robots:
                    answer = bid(robot_id, play.costs_s[robot_id], play.task_id)
                    play.market.bid(play.task_id, effect.round_number, robot_id, answer, play.now_s)


def test_a_word_of_declining_that_comes_late_changes_nothing():
    play = Play(a=10.0, b=30.0)
    first = play.award()
    play.decline(first)
    second = play.award()
    play.decline(first)
    assert (play.task.state, play.task.epoch) == ("awarded", second.award.epoch)
