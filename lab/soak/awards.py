"""Who got a task, and why he (I1, I10): judged by the awards and the bids on the wire."""

from __future__ import annotations

import json
import math
from collections import defaultdict, deque
from dataclasses import dataclass, field

from core.errors import Overtaken
from core.mesh.client import Answer
from core.wire.market import BID_WINDOW_S, Bid, BidRound, Task
from lab.soak.case import Case
from lab.soak.net import Message

QUESTIONS_KEPT = 8


@dataclass(frozen=True, slots=True)
class _Heard:
    """A bid that came to its plant."""

    at_s: float
    robot_id: str
    cost_s: float


@dataclass(slots=True)
class _Question:
    """The same words to every robot, sent at one moment: a round."""

    left_s: float
    words: bytes
    heard: list[_Heard] = field(default_factory=list)


class Awards:
    """Every award on the wire, and every round that a document tells of."""

    def __init__(self, case: Case) -> None:
        self._case = case
        self._asked: dict[int, _Question] = {}
        """By the message's number, until its answer has come."""
        self._questions: defaultdict[str, deque[_Question]] = defaultdict(lambda: deque(maxlen=QUESTIONS_KEPT))
        """A task's latest."""
        self._rounds: set[tuple[str, int]] = set()
        self._lives: dict[str, object] = {}

    def awarded(self, message: Message) -> None:
        """I1: one epoch, one robot."""
        award = json.loads(message.body)
        task_id, epoch = award["announcement"]["task_id"], award["epoch"]
        holder = self._case.awards.setdefault((task_id, epoch), message.target)
        if holder != message.target:
            self._case.breach("I1", f"{task_id} epoch {epoch} was awarded to {holder} and to {message.target}")

    def refused(self, message: Message, answer: Answer) -> None:
        """A robot did not take an award."""
        if message.target.startswith("robot") and json.loads(answer.body)["title"] == Overtaken.title:
            award = json.loads(message.body)
            self._case.declined.add((award["announcement"]["task_id"], award["epoch"]))

    def asked(self, message: Message) -> None:
        """A question for a bid leaves its plant."""
        questions = self._questions[json.loads(message.body)["task_id"]]
        now_s = self._case.truth.now()
        if not questions or (questions[-1].left_s, questions[-1].words) != (now_s, message.body):
            questions.append(_Question(now_s, message.body))
        self._asked[message.number] = questions[-1]

    def heard(self, message: Message, answer: Answer) -> None:
        """A robot's answer has come to its plant."""
        question = self._asked.pop(message.number, None)
        if question is not None and answer.status == 200:
            cost_s = json.loads(answer.body)["cost_s"]
            offer_s = math.inf if cost_s is None else cost_s
            question.heard.append(_Heard(self._case.truth.now(), message.target, offer_s))

    def read(self, plant_id: str, task: Task) -> None:
        """I10: the rounds of a task as they are on disk."""
        for entry in task.rounds:
            if entry.winner and (task.task_id, entry.epoch) not in self._rounds:
                self._rounds.add((task.task_id, entry.epoch))
                self._round(plant_id, task, entry)

    def _round(self, plant_id: str, task: Task, entry: BidRound) -> None:
        """The cheapest won, of those in the round and of those that came."""
        case = self._case
        if not self._same_life(plant_id):
            return  # its times are those of a clock that is gone
        offers = [bid for bid in entry.bids if bid.cost_s is not None]
        won = next((bid for bid in offers if bid.robot_id == entry.winner), None)
        if won is None or won.cost_s is None:
            return case.breach("I10", f"{task.task_id} went to {entry.winner}, which offered nothing")
        best = min(offers, key=_price)
        if _price(best) < _price(won):
            case.breach("I10", f"{task.task_id} went to {entry.winner} at {won.cost_s:.1f} s, not to {best.robot_id}")
        counted = {bid.robot_id for bid in offers}
        for heard in self._came(task.task_id, case.loop_s(plant_id, entry.t_s)):
            if (heard.cost_s, heard.robot_id) < _price(won) and heard.robot_id not in counted:
                offer = f"{heard.robot_id} offered {heard.cost_s:.1f} s"
                case.breach("I10", f"{task.task_id} went to {entry.winner}, though {offer}")

    def _came(self, task_id: str, closed_s: float) -> list[_Heard]:
        """The bids of the round that closed then, as far as they came in time."""
        asked = [q for q in self._questions[task_id] if closed_s - BID_WINDOW_S - 0.1 <= q.left_s <= closed_s]
        return [heard for heard in asked[-1].heard if heard.at_s <= closed_s - 0.005] if asked else []

    def _same_life(self, plant_id: str) -> bool:
        life = self._case.garden.running[plant_id].life
        before = self._lives.setdefault(plant_id, life)
        self._lives[plant_id] = life
        return before is life


def _price(bid: Bid) -> tuple[float, str]:
    return (math.inf if bid.cost_s is None else bid.cost_s, bid.robot_id)
