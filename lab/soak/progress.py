"""Whether work goes on (I1, I5, I7, I9): tasks end in time, both sides agree about them, nothing stays behind."""

from __future__ import annotations

import math
from collections import defaultdict

from core.allocation.queue import Entry
from core.wire.market import BID_WINDOW_S, FINAL_STATES, LEASE_S, Task
from lab.soak.case import Case
from robot_service.planner import TASK_S

LOOK_S = 10.0
AGREE_S = 2 * LEASE_S + LOOK_S
DONE_S = 3 * (BID_WINDOW_S + LEASE_S + max(TASK_S["water"], TASK_S["inventory"], TASK_S["harvest"]))
DRAIN_S = 1800.0
STALE_REPORT_S = 60.0
WELL_RATIO = 0.3
"""A robot with less charge would rather charge."""

_Holding = tuple[str, str, int]


class Progress:
    """Looked at every LOOK_S, and at the end of every calm."""

    def __init__(self, case: Case) -> None:
        self._case = case
        self._good_s: defaultdict[str, float] = defaultdict(float)
        """For how long some robot could have done an open task."""
        self._apart: dict[_Holding, float] = {}
        """Since when the two sides disagree."""

    def queues(self) -> dict[str, list[Entry]]:
        """The queue of every robot that runs."""
        garden = self._case.garden
        brains = {robot_id: garden.brain(robot_id) for robot_id in garden.names("robot")}
        return {
            robot_id: [entry for entry in brain.queue.entries if entry.announcement is not None]
            for robot_id, brain in brains.items()
            if brain is not None
        }

    def look(self, plant_id: str, tasks: list[Task], queues: dict[str, list[Entry]]) -> None:
        """At a plant's tasks."""
        for task in tasks:
            if task.state in FINAL_STATES:
                self._good_s.pop(task.task_id, None)
            else:
                self._in_time(plant_id, task)
                self._agree(plant_id, task, queues)

    def _in_time(self, plant_id: str, task: Task) -> None:
        """I5: time in which a capable robot could have done it."""
        good_s = self._good_s[task.task_id] + LOOK_S if self._able(plant_id) else min(0.0, self._good_s[task.task_id])
        if good_s > DONE_S:
            good_s = -math.inf
            why = f"{task.state} after {DONE_S:.0f} quiet seconds: {task.reason}"
            self._case.breach("I5", f"{task.task_id} ({task.kind}) is {why}")
        self._good_s[task.task_id] = good_s

    def _able(self, plant_id: str) -> bool:
        """Nothing has met the plant for a while, and some robot is well and has been."""
        case, quiet_s = self._case, self._case.truth.now() - 2 * LEASE_S
        if case.gremlin.touched_s[plant_id] > quiet_s or case.gremlin.touched_s["station"] > quiet_s:
            return False
        if case.garden.mesh.cut or case.truth.pots[plant_id].probe_silent:
            return False
        for robot_id in case.garden.names("robot"):
            body = case.truth.robots[robot_id]
            well = body.battery_ratio > WELL_RATIO and not body.pump_broken and robot_id not in case.stopped
            if well and case.gremlin.touched_s[robot_id] < quiet_s and robot_id in case.garden.running:
                return True
        return False

    # Agreement

    def _agree(self, plant_id: str, task: Task, queues: dict[str, list[Entry]]) -> None:
        """I7: the plant says that a robot holds it; the robot should say so too."""
        key = (task.task_id, task.robot_id, task.epoch)
        held = task.state in ("awarded", "running") and task.robot_id in queues
        theirs = any((e.task_id, e.epoch) == (task.task_id, task.epoch) for e in queues.get(task.robot_id, ()))
        waits = bool(task.permit_id) or "soaking" in task.phase
        self._disagree(key, held and not theirs and not waits, plant_id, task.robot_id, "the plant says so alone")

    def look_into(self, robot_id: str, queue: list[Entry]) -> None:
        """I1: nothing twice in a queue. I7: the robot says that it holds a task; its plant should say so too."""
        names = [entry.task_id for entry in queue]
        for task_id in {name for name in names if names.count(name) > 1}:
            self._case.breach("I1", f"{robot_id} has {task_id} in its queue twice")
        for entry in queue:
            pot = self._case.garden.pot(entry.plant_id)
            if pot is None:
                continue
            task = next((t for t in pot.place.market.open_tasks() if t.task_id == entry.task_id), None)
            held = task is not None and task.state in ("awarded", "running")
            mine = held and task is not None and (task.robot_id, task.epoch) == (robot_id, entry.epoch)
            key = (entry.task_id, f"{robot_id}?", entry.epoch)
            self._disagree(key, not mine and not entry.committed, entry.plant_id, robot_id, "the robot says so alone")

    def _disagree(self, key: _Holding, apart: bool, plant_id: str, robot_id: str, how: str) -> None:
        case = self._case
        if not apart or case.away(plant_id) or case.away(robot_id):
            self._apart.pop(key, None)
            return
        now_s, touched_s = case.truth.now(), case.gremlin.touched_s
        since_s = max(self._apart.setdefault(key, now_s), touched_s[plant_id], touched_s[robot_id])
        if now_s - since_s > AGREE_S and not case.garden.mesh.cut:
            self._apart[key] = math.inf
            case.breach("I7", f"{robot_id} holds {key[0]} epoch {key[2]} for {AGREE_S:.0f} s: {how}")

    # Ends

    def drained(self) -> None:
        """I9: a calm has lasted; nothing old may be left."""
        for plant_id in self._case.garden.names("plant"):
            self._nothing_old(plant_id)
        for robot_id in self._case.garden.names("robot"):
            self._nothing_untold(robot_id)

    def _nothing_old(self, plant_id: str) -> None:
        case, pot = self._case, self._case.garden.pot(plant_id)
        if pot is None:
            return case.breach("I9", f"{plant_id} did not come back")
        for task in pot.place.market.open_tasks():
            age_s = case.truth.now() - case.born_s.get(task.task_id, case.truth.now())
            if age_s > DRAIN_S and not case.truth.pots[plant_id].probe_silent:
                why = f"still {task.state} after a calm: {task.reason or task.phase}"
                case.breach("I9", f"{task.task_id} ({task.kind}) is {why}")

    def _nothing_untold(self, robot_id: str) -> None:
        case, brain = self._case, self._case.garden.brain(robot_id)
        if brain is None:
            return case.breach("I9", f"{robot_id} did not come back")
        stale = [f for f in brain.reporter._finals if brain.clock.now() - f.since_s > STALE_REPORT_S]
        if stale:
            case.breach("I9", f"{robot_id} cannot get rid of its report about {stale[0].entry.task_id}")
