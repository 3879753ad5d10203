"""A task's story out of several histories, and its drawing: told of what the market's own machine did."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

from console import diagram
from console.story import Story, remembered, tell
from core.allocation.plant_side import Market
from core.allocation.plant_state import Grant, Note, Solicit
from core.errors import ConfigError
from core.wire.documents import HistoryEntry
from core.wire.geometry import Point3, Pose2
from core.wire.market import Bid, PermitRequest, PlantCard, Report

TASK = "plant-1:1:1"


class Played:
    """One plant's market and the words of two robots."""

    def __init__(self) -> None:
        point = Point3(x_m=0.0, y_m=0.0, z_m=0.25)
        dock = Pose2(x_m=0.55, y_m=0.0, yaw_rad=3.14)
        self.market = Market(PlantCard(plant_id="plant-1", url="http://x", stem=point, dock=dock, nozzle=point), None, 0.0)
        self.market.soil(0.176, "", 0.0)
        self.market.ask("water", 150.0, "soil", "water content 0.176 is below 0.200", 0.0)
        self.plant: list[HistoryEntry] = []
        self.robots: dict[str, list[HistoryEntry]] = {"robot-1": [], "robot-2": []}

    def bids(self, now_s: float, **costs_s: float | None) -> None:
        """A round: `robot_1=3.0`; None is unable."""
        self.market.tick(now_s, list(self.robots))
        for ask in self.effects(now_s):
            if isinstance(ask, Solicit):
                for name, cost_s in costs_s.items():
                    robot_id = name.replace("_", "-")
                    bid = Bid(task_id=TASK, robot_id=robot_id, cost_s=cost_s, reason="" if cost_s else "no water")
                    self.market.bid(TASK, ask.round_number, robot_id, bid, now_s)
        for grant in self.effects(now_s):
            if isinstance(grant, Grant):
                self.market.award_answered(TASK, grant.award.epoch, "", now_s)

    def effects(self, now_s: float) -> list[object]:
        found: list[object] = list(self.market.take_effects())
        for note in found:
            if isinstance(note, Note):
                self.note(self.plant, now_s, note.kind, note.what, note.task_id)
        return found

    def note(self, book: list[HistoryEntry], t_s: float, kind: str, what: str, task_id: str = "") -> None:
        book.append(HistoryEntry(id=len(book) + 1, t_s=t_s, kind=kind, what=what, task_id=task_id))

    def report(self, now_s: float, robot: str, epoch: int, state: str, **more: object) -> None:
        self.market.report(TASK, Report(robot_id=robot, epoch=epoch, state=state, **more), now_s)  # type: ignore[arg-type]
        self.effects(now_s)

    def permit(self, now_s: float, robot: str, epoch: int) -> None:
        self.market.permit(TASK, PermitRequest(robot_id=robot, epoch=epoch, act="water"), "k", now_s)
        self.effects(now_s)

    def story(self) -> Story:
        return tell(self.market.task(TASK), self.plant, self.robots)


def fig13() -> Story:
    """Robot 1 wins with 3, then says 7; robot 2 says 4, gets the task and does it (paper 000, figure 13)."""
    played = Played()
    played.bids(0.0, robot_1=3.0, robot_2=4.0)
    played.report(6.0, "robot-1", 1, "awarded", phase="queued")
    one, two = played.robots.values()
    played.note(one, 0.0, "award", "water for plant-1", TASK)
    played.note(one, 5.0, "bump", "something is in the way")
    played.bids(10.0, robot_1=7.0, robot_2=4.0)
    played.note(one, 10.0, "kill", "water dropped: killed by plant-1", TASK)
    played.note(one, 11.0, "bump", "long after")
    played.note(two, 10.0, "award", "water for plant-1", TASK)
    played.note(two, 10.2, "task", "begins water plant-1", TASK)
    played.note(two, 10.2, "task", "begins water plant-3", "plant-3:1:1")
    played.report(10.3, "robot-2", 2, "running", phase="navigate")
    played.permit(15.0, "robot-2", 2)
    played.report(36.0, "robot-2", 2, "done", delivered_ml=149.0)
    played.market.soil(0.225, "", 96.0)
    played.effects(96.0)
    return played.story()


def test_the_story_of_figure_13_is_told_in_order_from_all_three_histories() -> None:
    told = [(step.who, step.what) for step in fig13().steps]
    print("\n".join(f"{who:<22} {what}" for who, what in told))
    assert told == [
        ("plant-1", "asked for by soil: water content 0.176 is below 0.200"),
        ("plant-1 -> robot-1", "water: your bid?"),
        ("robot-1 -> plant-1", "3.0 s"),
        ("plant-1 -> robot-2", "water: your bid?"),
        ("robot-2 -> plant-1", "4.0 s"),
        ("plant-1 -> robot-1", "award, epoch 1"),
        ("robot-1", "something is in the way"),
        ("plant-1 -> robot-1", "water: your bid?"),
        ("robot-1 -> plant-1", "7.0 s"),
        ("plant-1 -> robot-2", "water: your bid?"),
        ("robot-2 -> plant-1", "4.0 s"),
        ("plant-1 -> robot-1", "kill task, epoch 1"),
        ("plant-1 -> robot-2", "award, epoch 2"),
        ("robot-1", "water dropped: killed by plant-1"),
        ("robot-2", "begins water plant-1"),
        ("robot-2 -> plant-1", "navigate"),
        ("robot-2 -> plant-1", "may I?"),
        ("plant-1 -> robot-2", "permit plant-1:1:p2 for 150 ml"),
        ("robot-2 -> plant-1", "done"),
        ("plant-1", "done: soil went from 0.176 to 0.225"),
    ]


def test_silence_refusals_and_nobody_are_told_as_what_they_were() -> None:
    played = Played()
    played.bids(0.0, robot_1=None, robot_2=None)
    played.bids(1.0, robot_1=5.0)  # robot-2 does not answer
    played.bids(3.0)
    played.bids(12.0)
    played.bids(12.0, robot_1=5.0, robot_2=9.0)
    played.report(12.5, "robot-1", 2, "failed", reason="the base is down")
    told = [(step.who, step.what) for step in played.story().steps]
    print("\n".join(f"{who:<22} {what}" for who, what in told))
    for line in (
        ("robot-1 -> plant-1", "no: no water"),
        ("plant-1", "nobody can take it"),
        ("plant-1", "robot-2 did not answer"),
        ("plant-1", "robot-1 fell silent for 8 s"),
        ("plant-1 -> robot-1", "kill task, epoch 1"),
        ("robot-1 -> plant-1", "failed: the base is down"),
    ):
        assert line in told
    assert told.index(("plant-1 -> robot-1", "award, epoch 1")) < told.index(("plant-1 -> robot-1", "award, epoch 2"))


def test_a_task_that_its_pot_has_forgotten_is_told_from_the_history_alone() -> None:
    played = Played()
    played.bids(0.0, robot_1=3.0, robot_2=4.0)
    played.bids(12.0)  # robot-1 has not said a word
    played.bids(12.0, robot_1=None, robot_2=4.0)
    played.permit(15.0, "robot-2", 2)
    played.report(36.0, "robot-2", 2, "done", delivered_ml=149.0)
    played.market.soil(0.225, "", 96.0)
    played.effects(96.0)
    task = remembered(TASK, played.plant)
    assert task is not None
    whole = played.market.task(TASK)
    assert (task.kind, task.state, task.plant_id) == ("water", "done", "plant-1")
    assert (task.robot_id, task.epoch, task.asked_by, task.why) == ("robot-2", 2, "soil", whole.why)
    told = [(step.who, step.what) for step in tell(task, played.plant, played.robots).steps]
    assert told == [
        ("plant-1", "asked for by soil: water content 0.176 is below 0.200"),
        ("plant-1 -> robot-1", "award, epoch 1"),
        ("plant-1", "robot-1 fell silent for 8 s"),
        ("plant-1 -> robot-1", "kill task, epoch 1"),
        ("plant-1 -> robot-2", "award, epoch 2"),
        ("robot-2 -> plant-1", "may I?"),
        ("plant-1 -> robot-2", "permit plant-1:1:p2 for 150 ml"),
        ("robot-2 -> plant-1", "done"),
        ("plant-1", "done: soil went from 0.176 to 0.225"),
    ]
    assert remembered("plant-1:1:9", played.plant) is None


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("water", ["asked for by operator: asked by hand", "permit plant-1:1:p2 for 90 ml"]),
        ("water", ["asked for by soil: water content 0.190 has not reached 0.240"]),
        ("inventory", ["asked for by operator: asked by hand", "robot-2 has scanned"]),
        ("inventory", ["asked for by fruit: nobody told how the pick of f3 ended"]),
        ("inventory", ["asked for by fruit: f1, f2 should be looked at: ripe by now"]),
        ("harvest", ["asked for by operator: asked by hand", "permit plant-1:1:p4 for plant-1:f3"]),
        ("harvest", ["asked for by console: order o1767", "nobody told how the pick of f3 ended: a scan comes first"]),
        ("harvest", ["asked for by fruit: 2 ripe fruit"]),
        (None, ["asked for by operator: asked by hand", "cancelled: cancelled by operator"]),
    ],
)
def test_of_what_kind_a_forgotten_task_was_is_read_from_its_words(kind: str | None, words: list[str]) -> None:
    entries = [HistoryEntry(id=i, t_s=float(i), kind="announced", what=what, task_id=TASK) for i, what in enumerate(words)]
    task = remembered(TASK, entries)
    assert (task and task.kind) == kind


def test_the_diagram_has_the_plant_between_its_robots_and_every_message_in_order() -> None:
    drawn = diagram.text(fig13()).splitlines()
    print("\n".join(drawn))
    head = drawn[0]
    assert head.index("robot-1") < head.index("plant-1") < head.index("robot-2")
    order = [
        next(i for i, line in enumerate(drawn) if words in line)
        for words in ("- 3.0 s -", "- 7.0 s -", "kill task", "epoch 2")
    ]
    assert order == sorted(order)
    kill = drawn[order[2]]
    assert kill.index("<-") < kill.index("kill task")
    assert max(map(len, drawn)) <= 120
    assert [line for line in drawn if line.endswith(" ")] == []


def test_a_long_word_stays_in_its_column() -> None:
    played = Played()
    played.bids(0.0, robot_1=3.0, robot_2=4.0)
    played.report(0.5, "robot-1", 1, "running", phase="waits " * 40)
    played.note(played.robots["robot-2"], 0.6, "x", "says " * 40, TASK)
    drawn = diagram.text(played.story())
    assert "…" in drawn
    assert max(map(len, drawn.splitlines())) <= 120


def test_svg_and_mermaid_hold_the_same_messages(tmp_path: Path) -> None:
    story = fig13()
    for name in ("a.svg", "a.mmd", "a.txt"):
        diagram.write(story, tmp_path / name)
    root = ElementTree.fromstring((tmp_path / "a.svg").read_text())
    said = [node.text for node in root.iter("{http://www.w3.org/2000/svg}text") if node.get("class") == "said"]
    messages = [step for step in story.steps if step.target]
    assert said == [step.what for step in messages]
    lines = (tmp_path / "a.mmd").read_text().splitlines()
    assert lines[0] == "sequenceDiagram"
    assert sum("->>" in line for line in lines) == len(messages)
    assert sum("Note over" in line for line in lines) == len(story.steps) - len(messages)
    with pytest.raises(ConfigError, match="cannot draw"):
        diagram.write(story, tmp_path / "a.gif")
