"""The invariants I1 to I10 (docs/reliability.md), judged from outside: by the truth, the messages, and what disks hold.

Nothing here is known to the services. Cheap checks run at every message and every act, the others at every look.
`acts`, `papers`, `progress` and `awards` judge; this takes what happens to whom it concerns.
"""

from __future__ import annotations

import asyncio
import json

from core.mesh.client import Answer
from lab.soak.acts import Acts
from lab.soak.awards import Awards
from lab.soak.case import Breach, Case, Tally
from lab.soak.faults import Gremlin
from lab.soak.garden import SoakGarden
from lab.soak.net import Message
from lab.soak.papers import Papers
from lab.soak.progress import LOOK_S, Progress
from lab.soak.world import Truth


class Judge:
    """Watches one garden; `breaches` is what it found."""

    def __init__(self, truth: Truth, gremlin: Gremlin) -> None:
        self._case = case = Case(truth, gremlin)
        self.acts, self.awards, self.progress = Acts(case), Awards(case), Progress(case)
        self.papers = Papers(case, self.awards.read, self.acts.settled)
        self._stops: set[str] = set()
        """E-stops that were confirmed: the same question gets the same answer again, also after a release."""
        self._stop_numbers: dict[str, int] = {}
        """The newest one confirmed of each robot: a release that names an older one must release nothing."""

    @property
    def breaches(self) -> list[Breach]:
        return self._case.breaches

    @property
    def tally(self) -> Tally:
        return self._case.tally

    def attach(self, garden: SoakGarden) -> None:
        self._case.garden = garden
        mesh = garden.mesh
        mesh.sent, mesh.arrived, mesh.answered, mesh.heard = self._sent, self._arrived, self._answered, self._heard
        self._case.gremlin.halted, self._case.truth.began = self.acts.halted, self.acts.began

    def ended_itself(self, name: str, why: str) -> None:
        """I4: no service ends by itself."""
        self._case.breach("I4", f"{name} ended by itself: {why}")

    async def watch(self) -> None:
        """Look again and again, until cancelled."""
        while True:
            self.look()
            await asyncio.sleep(LOOK_S)

    def look(self) -> None:
        """Whatever is judged by documents and queues."""
        queues = self.progress.queues()
        for plant_id in self._case.garden.names("plant"):
            self.progress.look(plant_id, self.papers.look(plant_id), queues)
        for robot_id, queue in queues.items():
            self.progress.look_into(robot_id, queue)

    # Messages

    def _sent(self, message: Message) -> None:
        if message.path == "/bids":
            self.awards.asked(message)

    def _arrived(self, message: Message) -> None:
        if message.method == "PATCH":
            self.papers.arrived(message)
        if message.method != "POST":
            return
        if message.path == "/tasks" and message.target.startswith("robot"):
            self.awards.awarded(message)
        elif message.path == "/resume" and self._newest(message):
            self._case.stopped.discard(message.target)

    def _newest(self, release: Message) -> bool:
        """Whether it names the newest stop that was confirmed, or one that came after."""
        return bool(json.loads(release.body)["stop_number"] >= self._stop_numbers.get(release.target, 0))

    def _answered(self, message: Message, answer: Answer) -> None:
        """What left a node."""
        if answer.status >= 400:
            self._refused(message, answer)
        if answer.status >= 300 or message.method == "GET":
            return
        if message.path.endswith("/permits"):
            self.acts.given(message, answer)
        if message.path == "/stop" and message.key not in self._stops:
            self._stops.add(message.key)
            self._case.stopped.add(message.target)
            self._stop_numbers[message.target] = json.loads(answer.body)["stop_number"]
        if message.target.startswith("plant"):
            self.papers.look(message.target)
            self.papers.answered(message, answer)

    def _refused(self, message: Message, answer: Answer) -> None:
        """I4: no 500. I7: no node fails to understand another."""
        route = f"{message.method} {message.path.partition('?')[0]}"
        if route == "POST /tasks" and answer.status == 409:
            self.awards.refused(message, answer)
        if answer.status == 500:
            self._case.breach("I4", f"{message.target} answered 500 to {route}")
        if answer.status in (400, 405, 422) and message.source != "operator":
            why = json.loads(answer.body)["detail"]
            self._case.breach("I7", f"{message.target} does not understand {route} of {message.source}: {why}")

    def _heard(self, message: Message, answer: Answer) -> None:
        if message.path == "/bids":
            self.awards.heard(message, answer)
