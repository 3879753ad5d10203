"""The judge of awards knows which answers belong to a round."""

from types import SimpleNamespace

import pytest

from core.mesh.client import Answer
from core.wire.market import Announcement, Bid, BidRound, PlantCard, Task
from lab.soak.awards import Awards
from lab.soak.net import Message

PLANT, NEAR, FAR = "plant-1", "robot-1", "robot-2"
TASK = "plant-1:1:1"


class Bench:
    """A judge whose clock we set, and one plant that asks two robots."""

    def __init__(self):
        self.now_s, self.broken, self._sent = 0.0, [], 0
        running = {PLANT: SimpleNamespace(life="first")}
        self.judge = Awards(
            SimpleNamespace(
                truth=SimpleNamespace(now=lambda: self.now_s),
                garden=SimpleNamespace(running=running),
                loop_s=lambda plant_id, garden_s: garden_s,
                breach=lambda invariant, what: self.broken.append((invariant, what)),
            )
        )

    def ask(self, at_s, holder=""):
        """A question to both; returns its messages."""
        self.now_s = at_s
        body = Announcement(task_id=TASK, kind="water", plant=card(), holder=holder).model_dump_json().encode()
        messages = []
        for robot_id in (NEAR, FAR):
            self._sent += 1
            messages.append(Message(self._sent, PLANT, robot_id, "POST", "/bids", body, ""))
            self.judge.asked(messages[-1])
        return messages

    def answer(self, message, at_s, cost_s):
        self.now_s = at_s
        bid = Bid(task_id=TASK, robot_id=message.target, cost_s=cost_s)
        self.judge.heard(message, Answer(200, bid.model_dump_json().encode()))

    def close(self, at_s, winner, offers):
        """The plant's document tells of a round."""
        self.now_s = at_s
        bids = [Bid(task_id=TASK, robot_id=name, cost_s=cost_s) for name, cost_s in offers.items()]
        entry = BidRound(t_s=at_s, epoch=1, bids=bids, winner=winner, why="cheapest")
        task = Task(
            task_id=TASK, kind="water", plant_id=PLANT, created_s=0.0, updated_s=at_s, state="awarded", rounds=[entry]
        )
        self.judge.read(PLANT, task)


def card():
    origin = {"x_m": 0.0, "y_m": 0.0}
    stem, dock = origin | {"z_m": 0.2}, origin | {"yaw_rad": 0.0}
    return PlantCard.model_validate(
        {"plant_id": PLANT, "url": "http://127.0.0.1:1", "stem": stem, "dock": dock, "nozzle": stem}
    )


@pytest.fixture
def bench():
    bench = Bench()
    bench.close(0.0, "", {})
    return bench


def test_a_robot_that_did_not_answer_this_question_did_not_offer_what_it_answered_to_the_one_before(bench):
    _, asked_before = bench.ask(10.0, holder=FAR)
    near, _ = bench.ask(10.3)
    bench.answer(asked_before, 10.4, 41.0)
    bench.answer(near, 10.5, 118.0)
    bench.close(12.3, NEAR, {NEAR: 118.0, FAR: None})
    assert bench.broken == []


def test_an_answer_that_came_in_time_and_was_left_out_is_a_breach(bench):
    near, far = bench.ask(10.0)
    bench.answer(near, 10.5, 118.0)
    bench.answer(far, 10.6, 41.0)
    bench.close(12.0, NEAR, {NEAR: 118.0, FAR: None})
    assert bench.broken == [("I10", f"{TASK} went to {NEAR}, though {FAR} offered 41.0 s")]


def test_whoever_bids_less_must_win(bench):
    bench.close(12.0, NEAR, {NEAR: 118.0, FAR: 41.0})
    assert bench.broken == [("I10", f"{TASK} went to {NEAR} at 118.0 s, not to {FAR}")]
