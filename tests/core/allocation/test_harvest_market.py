"""Harvest and inventory in the plant's market: one pick a fruit whatever is lost, doubts settled by a scan alone."""

from __future__ import annotations

import random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from core.allocation.picking import PICK_S_MAX, OpenPick, Picking, may_be_picked, settles, told
from core.allocation.plant_side import Market
from core.allocation.plant_state import Grant, Kill, MarketDocument, Solicit
from core.errors import Conflict, Refused
from core.wire.fruit import Fruit, Pick
from core.wire.geometry import Point3, Pose2
from core.wire.market import Bid, Permit, PermitRequest, PlantCard, Report

CARD = PlantCard(
    plant_id="plant-1", url="http://plant-1", stem=Point3(x_m=0.0, y_m=0.0, z_m=0.25),
    dock=Pose2(x_m=0.5, y_m=0.0, yaw_rad=3.0), nozzle=Point3(x_m=0.06, y_m=0.0, z_m=0.06),
)  # fmt: skip
ROBOTS = ("robot-1", "robot-2", "robot-3")


def bid(robot_id: str, cost_s: float | None, task_id: str) -> Bid:
    return Bid(task_id=task_id, robot_id=robot_id, cost_s=cost_s, reason="" if cost_s is not None else "unable")


def fruit(name: str, **more: Any) -> Fruit:
    return Fruit(fruit_id=name, colour="red", x_m=0.1, y_m=0.0, z_m=0.2, radius_m=0.013, **more)


def market(names: str = "f1 f2 f3", document: MarketDocument | None = None, now_s: float = 0.0) -> Market:
    made = Market(CARD, document and document.by_clock(now_s), now_s)
    made.fruits([fruit(name) for name in names.split()], now_s)
    return made


def give(made: Market, task_id: str, now_s: float, robot_id: str = "robot-1") -> None:
    """Have it asked for and awarded to this robot."""
    made.tick(now_s, [robot_id])
    ask = next(e for e in made.take_effects() if isinstance(e, Solicit) and e.announcement.task_id == task_id)
    made.bid(task_id, ask.round_number, robot_id, bid(robot_id, 5.0, task_id), now_s)


def harvest(made: Market, now_s: float = 0.0, names: str = "f1 f2 f3", count: int = 2) -> str:
    task_id = made.ask("harvest", 0.0, "fruit", "ripe", now_s, fruit_ids=names.split(), count=count).task_id
    give(made, task_id, now_s)
    return task_id


def permit(made: Market, task_id: str, name: str, now_s: float, key: str = "", robot_id: str = "robot-1") -> Permit:
    epoch = made.task(task_id).epoch
    return made.permit(task_id, PermitRequest(robot_id=robot_id, epoch=epoch, act="pick", fruit_id=name), key, now_s)


def tell(
    made: Market, task_id: str, now_s: float, state: Any = "running", *picks: Pick, epoch: int = 0, **more: Any
) -> bool:
    report = Report(robot_id=more.pop("robot_id", "robot-1"), epoch=epoch or made.task(task_id).epoch, state=state,
                    picks=list(picks), **more)  # fmt: skip
    return made.report(task_id, report, now_s).keep


def pick(name: str, outcome: Any = "picked", permit_id: str = "", reason: str = "") -> Pick:
    return Pick(fruit_id=name, outcome=outcome, permit_id=permit_id, reason=reason)


def test_an_announcement_names_the_fruit_and_how_many_are_wanted() -> None:
    made = market()
    made.ask("harvest", 0.0, "operator", "an order", 0.0, fruit_ids=["f2", "f1", "f9"], count=1, order_id="o1")
    made.tick(0.0, ROBOTS)
    (ask,) = [e for e in made.take_effects() if isinstance(e, Solicit)]
    told = ask.announcement
    assert ([f.fruit_id for f in told.fruits], told.count, told.order_id) == (["f2", "f1"], 1, "o1")


def test_a_harvest_is_done_when_enough_is_picked_each_fruit_under_its_own_permit() -> None:
    made = market()
    task_id = harvest(made)
    first = permit(made, task_id, "f1", 1.0)
    with pytest.raises(Refused, match="not settled"):
        permit(made, task_id, "f2", 2.0)
    assert tell(made, task_id, 3.0, "running", one := pick("f1", permit_id=first.permit_id))
    second = permit(made, task_id, "f2", 4.0)
    assert tell(made, task_id, 8.0, "running", one, two := pick("f2", permit_id=second.permit_id))
    with pytest.raises(Refused, match="2 fruit are wanted"):
        permit(made, task_id, "f3", 9.0)
    assert tell(made, task_id, 10.0, "done", one, two)
    task = made.task(task_id)
    assert (task.state, [p.fruit_id for p in task.picks]) == ("done", ["f1", "f2"])
    assert made.document().open_pick is None


def test_the_same_key_gets_the_same_permit_and_the_same_report_changes_nothing() -> None:
    made = market()
    task_id = harvest(made)
    first = permit(made, task_id, "f1", 1.0, key="k")
    again = permit(made, task_id, "f1", 3.0, key="k")
    assert (again.permit_id, again.valid_for_s) == (first.permit_id, first.valid_for_s - 2.0)
    done = pick("f1", permit_id=first.permit_id)
    tell(made, task_id, 4.0, "running", done)
    before = made.task(task_id)
    tell(made, task_id, 4.0, "running", done, done)
    assert made.task(task_id).picks == before.picks
    with pytest.raises(Refused, match="not for"):
        permit(made, task_id, "f1", 5.0, key="other")


@pytest.mark.parametrize("outcome", ["failed", "unreachable"])
def test_what_could_not_be_picked_is_not_tried_again_by_this_task_and_the_rest_is_said(outcome: Any) -> None:
    made = market("f1")
    task_id = harvest(made, names="f1", count=1)
    tell(made, task_id, 2.0, "running", told := pick("f1", outcome, reason="behind the stem"))
    tell(made, task_id, 3.0, "done", told)
    task = made.task(task_id)
    assert task.state == "failed"
    assert "0 of 1 picked" in task.reason
    assert "behind the stem" in task.reason


def test_some_of_the_wanted_fruit_is_done_with_the_reason_for_the_rest() -> None:
    made = market("f1 f2")
    task_id = harvest(made, names="f1 f2", count=2)
    first = permit(made, task_id, "f1", 1.0)
    tell(made, task_id, 3.0, "done", pick("f1", permit_id=first.permit_id), pick("f2", "unreachable", reason="too high"))
    assert made.task(task_id).state == "done"
    assert "1 of 2 picked" in made.task(task_id).reason


@pytest.mark.parametrize(
    ("change", "may"),
    [
        ({}, True),
        ({"confidence": 0.6}, True),
        ({"confidence": 0.59}, False),
        ({"sigma_m": 0.03}, True),
        ({"sigma_m": 0.031}, False),
        ({"unreachable": "too high"}, False),
        ({"failed": "slipped"}, False),
        ({"in_doubt": True}, False),
    ],
)
def test_a_hand_is_sent_only_for_what_is_known_well_enough(change: dict[str, Any], may: bool) -> None:
    assert may_be_picked(fruit("f1", **change)) == may


def test_the_times_of_a_pick_are_reckoned_from_its_permit() -> None:
    held = OpenPick(permit=Permit(permit_id="p", task_id="t", epoch=1, act="pick", fruit_id="f1", valid_for_s=15.0),
                    robot_id="robot-1", issued_s=1000.0)  # fmt: skip
    assert (held.act_over_s(), held.key) == (1075.0, "")
    assert [held.again(now_s).valid_for_s for now_s in (990.0, 1000.0, 1004.0, 1020.0)] == [15.0, 15.0, 11.0, 0.0]
    picks = Picking(held, [held])
    assert (picks.open, picks.doubts["f1"], picks.clear_s()) == (held, held, 1075.0)
    assert (picks.undecided(1074.9), picks.undecided(1075.0)) == (["f1", "f1"], ["f1"])
    assert (Picking(None, []).clear_s(), Picking(None, []).undecided(0.0)) == (0.0, [])
    woken = MarketDocument(open_pick=held, doubts=[held]).by_clock(50.0)
    assert woken.open_pick is not None
    assert (woken.open_pick.act_over_s(), woken.doubts[0].act_over_s()) == (125.0, 125.0)


def test_a_permit_is_held_by_its_robot_alone_and_known_by_its_name() -> None:
    held = OpenPick(permit=Permit(permit_id="p", task_id="t", epoch=1, act="pick", fruit_id="f1", valid_for_s=15.0),
                    robot_id="robot-1", issued_s=0.0)  # fmt: skip
    other = held.model_copy(update={"permit": held.permit.model_copy(update={"permit_id": "q", "fruit_id": "f2"})})
    picks = Picking(held, [other])
    assert [picks.holds(*who) for who in (("t", "robot-1", 1), ("t", "robot-1", 2), ("t", "robot-2", 1))] == [
        True,
        False,
        False,
    ]
    assert not Picking(None, [other]).holds("t", "robot-1", 1)
    assert (picks.held("p", "robot-1"), picks.held("q", "robot-1")) == (picks.open, picks.doubts["f2"])
    assert (picks.held("p", "robot-2"), picks.held("", "robot-1"), picks.held("r", "robot-1")) == (None, None, None)
    assert [settles(picks.open, pick(name, how), picks.open) for name, how in (("f1", "failed"), ("f2", "picked"))] == [
        True,
        False,
    ]
    doubt = picks.doubts["f2"]
    assert [settles(doubt, pick("f2", how), picks.open) for how in ("picked", "failed")] == [True, False]
    assert [settles(doubt, pick("f2", how), None) for how in ("picked", "failed")] == [True, False]
    assert not settles(None, pick("f1"), picks.open)
    picks.close(doubt)
    assert (picks.open is None, list(picks.doubts)) == (False, [])
    picks.close(held)
    assert picks.open is None


@pytest.mark.parametrize(
    ("name", "why"),
    [("f9", "f9 is not in the inventory"), ("", "a fruit without a name"), ("f4", "not for"), ("f3", "not for"), ("f2", "")],
)
def test_a_pick_is_refused_and_says_why(name: str, why: str) -> None:
    made = market("f1 f2 f3 f4")
    made.fruits([fruit("f1"), fruit("f2"), fruit("f3", unreachable="too high"), fruit("f4")], 0.0)
    task_id = harvest(made)
    if not why:
        assert permit(made, task_id, name, 1.0).fruit_id == name
        return
    with pytest.raises(Refused, match=why):
        permit(made, task_id, name, 1.0)


def test_how_a_harvest_went_is_told_in_a_sentence_of_bounded_length() -> None:
    made = market()
    task = made.ask("harvest", 0.0, "fruit", "ripe", 0.0, fruit_ids=["f1", "f2", "f3"], count=2)
    picks = [pick("f1"), pick("f2", "failed", reason="slipped"), pick("f3", "unreachable")]
    said = told(task.model_copy(update={"picks": picks}))
    assert said == "1 of 2 picked; f2 failed: slipped; f3 unreachable: no reason given"
    assert len(told(task.model_copy(update={"picks": [pick("f2", "failed", reason="x" * 499)]}))) == 500


def silent_after_permit(made: Market) -> tuple[str, Permit]:
    task_id = harvest(made)
    given = permit(made, task_id, "f1", 1.0)
    made.tick(12.0, ROBOTS[:1])
    return task_id, given


def test_after_a_lost_report_nothing_is_picked_until_a_scan_has_looked() -> None:
    made = market()
    task_id, _ = silent_after_permit(made)
    assert any(isinstance(e, Kill) for e in made.take_effects())
    assert (made.doubts, made.task(task_id).state) == (["f1"], "announced")
    made.tick(500.0, ROBOTS)
    assert not [e for e in made.take_effects() if isinstance(e, Solicit)]
    look = made.ask("inventory", 0.0, "fruit", "in doubt", 12.0).task_id
    assert made.undecided(12.0) == ["f1"]
    made.tick(20.0, ROBOTS)
    assert not [e for e in made.take_effects() if isinstance(e, Solicit)]  # the act may still be under way
    over_s = 1.0 + 15.0 + PICK_S_MAX
    give(made, look, over_s, "robot-2")
    assert made.undecided(over_s) == []
    made.scanned(look, "robot-2", "s1", over_s + 30.0)
    made.settle({"f1": False}, over_s + 30.0)
    made.fruits([fruit("f2"), fruit("f3")], over_s + 30.0)
    tell(made, look, over_s + 31.0, "done", robot_id="robot-2")
    assert made.task(look).state == "done"
    assert [(p.fruit_id, p.outcome) for p in made.task(task_id).picks] == [("f1", "picked")]
    give(made, task_id, over_s + 40.0, "robot-2")
    with pytest.raises(Refused):
        permit(made, task_id, "f1", over_s + 41.0, robot_id="robot-2")
    assert permit(made, task_id, "f2", over_s + 42.0, robot_id="robot-2").fruit_id == "f2"


def test_a_fruit_that_the_scan_finds_hanging_may_be_picked_after_all() -> None:
    made = market()
    task_id, _ = silent_after_permit(made)
    made.settle({"f1": True}, 200.0)
    made.take_effects()
    give(made, task_id, 201.0)
    assert permit(made, task_id, "f1", 202.0).fruit_id == "f1"


@pytest.mark.parametrize(("outcome", "believed"), [("picked", True), ("failed", False)])
def test_a_late_word_is_believed_when_it_says_picked(outcome: Any, believed: bool) -> None:
    made = market()
    task_id, given = silent_after_permit(made)
    assert not tell(made, task_id, 30.0, "running", pick("f1", outcome, given.permit_id), epoch=1)
    assert made.doubts == ([] if believed else ["f1"])


def test_another_robot_cannot_speak_for_a_permit() -> None:
    made = market()
    task_id = harvest(made)
    given = permit(made, task_id, "f1", 1.0)
    tell(made, task_id, 2.0, "running", pick("f1", permit_id=given.permit_id), robot_id="robot-2")
    assert made.task(task_id).picks == []
    tell(made, task_id, 2.0, "running", pick("f2"))
    assert made.task(task_id).picks == []  # picked without a permit is no pick


def test_a_holder_that_reports_but_never_tells_the_end_loses_the_task() -> None:
    made = market()
    task_id = harvest(made)
    permit(made, task_id, "f1", 1.0)
    for t in range(2, 80, 2):
        tell(made, task_id, float(t))
        made.tick(float(t), ROBOTS[:1])
    assert made.doubts == ["f1"]
    assert made.task(task_id).state == "announced"


def test_a_restart_keeps_the_open_pick_and_the_doubts() -> None:
    made = market()
    task_id = harvest(made)
    given = permit(made, task_id, "f1", 1.0, key="k")
    made = market(document=MarketDocument.model_validate(made.document().model_dump()), now_s=5.0)
    assert permit(made, task_id, "f1", 6.0, key="k").permit_id == given.permit_id
    with pytest.raises(Refused):
        permit(made, task_id, "f2", 6.0)
    made.tick(20.0, ROBOTS[:1])
    assert made.doubts == ["f1"]
    made = market(document=made.document(), now_s=30.0)
    assert made.doubts == ["f1"]
    assert made.undecided(30.0) == ["f1"]


def test_a_cancelled_harvest_leaves_its_open_pick_in_doubt() -> None:
    made = market()
    task_id = harvest(made)
    permit(made, task_id, "f1", 1.0)
    made.cancel(task_id, "operator", "", 2.0)
    assert made.doubts == ["f1"]


def test_an_inventory_ends_only_with_its_scan() -> None:
    made = market()
    task_id = made.ask("inventory", 0.0, "fruit", "never scanned", 0.0).task_id
    give(made, task_id, 0.0)
    with pytest.raises(Refused):
        made.scanned(task_id, "robot-2", "s1", 1.0)
    tell(made, task_id, 2.0, "done")
    assert made.task(task_id).state == "announced"
    made.take_effects()
    give(made, task_id, 5.0)
    made.scanned(task_id, "robot-1", "s1", 6.0)
    made.tick(60.0, ROBOTS[:1])  # it fell silent, but the scan is here
    assert made.task(task_id).state == "done"


def test_a_harvest_whose_fruit_have_all_gone_ends() -> None:
    made = market()
    task_id = made.ask("harvest", 0.0, "fruit", "ripe", 0.0, fruit_ids=["f1"], count=1).task_id
    made.fruits([fruit("f2")], 1.0)
    assert made.task(task_id).state == "failed"
    with pytest.raises(Refused):
        made.ask("harvest", 0.0, "fruit", "ripe", 2.0)
    made.ask("harvest", 0.0, "fruit", "ripe", 2.0, fruit_ids=["f2"], count=1)
    with pytest.raises(Conflict):
        made.ask("harvest", 0.0, "fruit", "ripe", 2.0, fruit_ids=["f2"], count=1)


def test_water_goes_on_beside_a_harvest() -> None:
    made = market()
    made.soil(0.15, "", 0.0)
    task_id = harvest(made)
    permit(made, task_id, "f1", 1.0)
    dry = made.ask("water", 100.0, "soil", "dry", 2.0).task_id
    give(made, dry, 2.0, "robot-2")
    asked = PermitRequest(robot_id="robot-2", epoch=1, act="water", amount_ml=100.0)
    assert made.permit(dry, asked, "", 3.0).dose_ml == 100.0
    with pytest.raises(Refused, match="does not water"):
        made.permit(task_id, PermitRequest(robot_id="robot-1", epoch=1, act="water"), "", 3.0)


class Play:
    """Two robots harvest a plant while words are lost, robots die, the plant restarts and scans come: the truth is kept."""

    def __init__(self, seed: int) -> None:
        self.rng, self.now_s = random.Random(seed), 0.0
        self.hanging = {f"f{i}" for i in range(1, 6)}
        self.listed = set(self.hanging)
        self.basket: list[str] = []
        self.market = market(" ".join(sorted(self.listed)))
        self.told: dict[tuple[str, int], list[Pick]] = {}
        self.acting: list[tuple[float, str, int, Permit]] = []
        self.used: set[str] = set()

    def run(self) -> None:
        for _ in range(400):
            self.now_s += self.rng.choice((0.5, 1.0, 2.0, 9.0, 40.0))
            self.step()
            self.check()

    def step(self) -> None:
        made, what = self.market, self.rng.random()
        self.act()
        ripe = sorted(self.listed - set(made.doubts))
        if made.open_of("harvest") is None and ripe and not made.doubts:
            made.ask("harvest", 0.0, "fruit", "ripe", self.now_s, fruit_ids=ripe, count=min(3, len(ripe)))
        if made.doubts and made.open_of("inventory") is None:
            made.ask("inventory", 0.0, "fruit", "in doubt", self.now_s)
        made.tick(self.now_s, ROBOTS[:2])
        for effect in made.take_effects():
            if isinstance(effect, Solicit):
                for name in effect.robots:
                    cost_s = self.rng.choice((5.0, 9.0, None))
                    made.bid(effect.announcement.task_id, effect.round_number, name,
                             bid(name, cost_s, effect.announcement.task_id), self.now_s)  # fmt: skip
            elif isinstance(effect, Grant) and self.rng.random() < 0.8:
                made.award_answered(effect.award.announcement.task_id, effect.award.epoch, "", self.now_s)
        if what < 0.03:
            self.market = market(" ".join(self.listed), made.document(), self.now_s)
        for task in self.market.open_tasks():
            if task.state in ("awarded", "running") and self.rng.random() < 0.8:
                {"harvest": self.harvest, "inventory": self.scan}[task.kind](task.task_id, task.robot_id, task.epoch)

    def harvest(self, task_id: str, robot_id: str, epoch: int) -> None:
        told = self.told.setdefault((robot_id, epoch), [])
        if self.rng.random() < 0.5:
            name = self.rng.choice(sorted(self.market.task(task_id).fruit_ids))
            try:
                request = PermitRequest(robot_id=robot_id, epoch=epoch, act="pick", fruit_id=name)
                given = self.market.permit(task_id, request, f"{epoch}/{name}", self.now_s)
            except Refused:
                pass
            else:
                # A robot takes a permit for one shot, and none whose time is over.
                fresh = given.valid_for_s > 0.0 and given.permit_id not in self.used
                if self.rng.random() < 0.8 and fresh:
                    self.used.add(given.permit_id)
                    begin_s = self.now_s + self.rng.uniform(0.0, given.valid_for_s)
                    self.acting.append((begin_s + self.rng.uniform(1.0, PICK_S_MAX), robot_id, epoch, given))
        state = self.rng.choice(("running", "running", "running", "done", "failed"))
        self.send(task_id, robot_id, epoch, state, told)

    def send(self, task_id: str, robot_id: str, epoch: int, state: Any, told: list[Pick]) -> None:
        """The report reaches the plant, or not."""
        if self.rng.random() < 0.6:
            report = Report(robot_id=robot_id, epoch=epoch, state=state, picks=told)
            for verdict in self.market.verdicts(task_id, report):
                if verdict.outcome == "picked":
                    self.listed.discard(verdict.fruit_id)
            self.market.fruits([fruit(name) for name in self.listed], self.now_s)
            self.market.report(task_id, report, self.now_s)

    def act(self) -> None:
        """The fruit comes off when its pick ends; the robot keeps the word for its next report."""
        for entry in [e for e in self.acting if e[0] <= self.now_s]:
            self.acting.remove(entry)
            _, robot_id, epoch, given = entry
            got = given.fruit_id in self.hanging and self.rng.random() < 0.8
            if got:
                self.hanging.remove(given.fruit_id)
                self.basket.append(given.fruit_id)
            outcome = "picked" if got else "failed"
            self.told.setdefault((robot_id, epoch), []).append(pick(given.fruit_id, outcome, given.permit_id))

    def scan(self, task_id: str, robot_id: str, epoch: int) -> None:
        undecided = self.market.undecided(self.now_s)
        decided = {name: name in self.hanging for name in self.market.doubts if name not in undecided}
        self.market.scanned(task_id, robot_id, f"s{self.now_s}", self.now_s)
        self.listed -= {name for name, hanging in decided.items() if not hanging}
        self.market.settle(decided, self.now_s)
        self.market.fruits([fruit(name) for name in self.listed], self.now_s)
        self.market.report(task_id, Report(robot_id=robot_id, epoch=epoch, state="done"), self.now_s)

    def check(self) -> None:
        """One act under way a plant; what hangs is listed; what is listed and gone is in doubt or about to be told."""
        assert len({given.fruit_id for *_, given in self.acting}) == len(self.acting), "two picks of one fruit at once"
        assert self.hanging <= self.listed, f"the plant forgot {self.hanging - self.listed}"
        unsettled = set(self.market.undecided(self.now_s)) | set(self.market.doubts)
        phantoms = self.listed - self.hanging - unsettled
        assert not phantoms, f"{phantoms} were picked, and the plant would have them picked again"


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32))
def test_no_lost_word_ever_leads_to_a_second_pick_or_a_phantom(seed: int) -> None:
    play = Play(seed)
    play.run()
    assert len(play.basket) == len(set(play.basket)), f"seed {seed}"


def test_the_play_is_busy_and_finds_a_market_that_forgets_its_doubts(monkeypatch: pytest.MonkeyPatch) -> None:
    """A test of the test."""
    plays = [Play(seed) for seed in range(20)]
    for play in plays:
        play.run()
    assert sum(len(play.basket) for play in plays) > 60

    def forget(self: Picking) -> str:
        assert self.open is not None
        fruit_id, self.open = self.open.permit.fruit_id, None
        return fruit_id

    monkeypatch.setattr(Picking, "doubt", forget)

    def play_all() -> None:
        for seed in range(20):
            Play(seed).run()

    with pytest.raises(AssertionError, match=r"two picks|picked again"):
        play_all()
