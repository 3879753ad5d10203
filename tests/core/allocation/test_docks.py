from __future__ import annotations

import random

import pytest

from core.allocation.docks import WISH_S, Docks, DocksDocument
from core.errors import Conflict, Forbidden, NotFound, Unprocessable
from core.wire.market import Reservation, ReservationRequest


def ask(docks: Docks, robot: str, now_s: float, *, for_s: float = 30.0, yielding: bool = False) -> Reservation:
    request = ReservationRequest(robot_id=robot, dock_id="tap", for_s=for_s, yielding=yielding)
    return docks.reserve(request, now_s)


def station(document: DocksDocument | None = None, now_s: float = 0.0) -> Docks:
    return Docks("station", ["tap", "spare"], document, now_s)


def test_a_loan_ends_by_itself_and_a_renewal_keeps_its_name() -> None:
    docks = station()
    first = ask(docks, "a", 0.0)
    assert ask(docks, "a", 20.0).reservation_id == first.reservation_id
    assert docks.loan("tap", 49.0).robot_id == "a"
    assert docks.loan("tap", 51.0).robot_id == ""


def test_only_a_change_of_holder_needs_the_disk() -> None:
    docks = station()
    ask(docks, "a", 0.0)
    assert docks.dirty
    docks.dirty = False
    ask(docks, "a", 10.0)
    assert not docks.dirty


def test_whoever_asked_first_is_next_unless_it_stopped_asking() -> None:
    docks = station()
    held = ask(docks, "a", 0.0)
    for robot in ("b", "c"):
        with pytest.raises(Conflict, match="held by a"):
            ask(docks, robot, 1.0)
    docks.release(held.reservation_id, "a")
    with pytest.raises(Conflict, match="b asked first"):
        ask(docks, "c", 2.0)
    assert ask(docks, "c", 1.1 + WISH_S).robot_id == "c"


def test_a_yielding_holder_learns_who_waits() -> None:
    docks = station()
    assert ask(docks, "a", 0.0, yielding=True).wanted_by == ""
    with pytest.raises(Conflict, match="rests"):
        ask(docks, "b", 1.0)
    assert ask(docks, "a", 2.0, yielding=True).wanted_by == "b"
    assert ask(docks, "a", 3.0 + WISH_S, yielding=True).wanted_by == ""


def test_releasing_is_the_holders_and_an_old_name_does_nothing() -> None:
    docks = station()
    old = ask(docks, "a", 0.0)
    with pytest.raises(Forbidden):
        docks.release(old.reservation_id, "b")
    assert docks.release(old.reservation_id, "a") == "tap"
    new = ask(docks, "b", 1.0)
    assert new.epoch == old.epoch + 1
    assert docks.release(old.reservation_id, "a") == ""
    assert docks.loan("tap", 2.0).robot_id == "b"
    assert docks.release(new.reservation_id, "") == "tap"
    with pytest.raises(NotFound):
        docks.release("elsewhere:tap:1", "a")


def test_after_a_restart_the_holder_has_its_whole_time_again() -> None:
    docks = station()
    ask(docks, "a", 0.0, for_s=40.0)
    again = station(docks.document(), 1000.0)
    assert again.loan("tap", 1039.0).robot_id == "a"
    with pytest.raises(Conflict):
        ask(again, "b", 1000.0)
    assert ask(again, "b", 1041.0).epoch == 2


def test_a_loan_is_over_at_its_very_end_and_a_wish_only_after_its_time() -> None:
    docks = station()
    ask(docks, "a", 0.0)
    assert docks.loan("tap", 29.999).robot_id == "a"
    with pytest.raises(Conflict):
        ask(docks, "b", 29.0)
    docks.dirty = False
    assert docks.loan("tap", 30.0).robot_id == ""
    assert docks.dirty
    assert docks.wanted_by("tap", 29.0 + WISH_S) == "b"
    with pytest.raises(Conflict, match="b asked first"):
        ask(docks, "c", 29.0 + WISH_S)
    assert docks.wanted_by("tap", 29.1 + WISH_S) == "c"


def test_nothing_is_written_before_anything_changed() -> None:
    docks = station()
    assert not docks.dirty
    assert [(loan.dock_id, loan.robot_id, loan.epoch, loan.for_s) for loan in docks.document().loans] == [
        ("tap", "", 0, 0.0),
        ("spare", "", 0, 0.0),
    ]
    assert not docks.document().loans[0].yielding


def test_a_look_at_a_free_dock_changes_nothing() -> None:
    docks = station()
    assert (docks.loan("tap", 5.0).robot_id, docks.dirty) == ("", False)


def test_who_is_served_no_longer_waits() -> None:
    docks = station()
    held = ask(docks, "a", 0.0, yielding=True)
    with pytest.raises(Conflict):
        ask(docks, "b", 1.0)
    docks.release(held.reservation_id, "a")
    given = ask(docks, "b", 2.0)
    assert (given.wanted_by, given.epoch, given.valid_for_s, given.dock_id) == ("", 2, 30.0, "tap")
    assert given.reservation_id == "station:tap:2"
    assert docks.wanted_by("tap", 2.0) == ""


def test_a_dock_without_a_name_is_the_only_one_there_is() -> None:
    nameless = ReservationRequest(robot_id="a", dock_id="", for_s=30.0)
    alone = Docks("plant-1", ["dock"], None, 0.0)
    assert alone.reserve(nameless, 0.0).dock_id == "dock"
    with pytest.raises(Unprocessable, match="several docks"):
        station().reserve(nameless, 0.0)
    with pytest.raises(NotFound, match="no dock elsewhere"):
        station().loan("elsewhere", 0.0)


def test_a_free_dock_has_nothing_to_release() -> None:
    docks = station()
    assert docks.release("station:tap:0", "a") == ""
    spare = ReservationRequest(robot_id="a", dock_id="spare", for_s=30.0)
    assert docks.release(docks.reserve(spare, 0.0).reservation_id, "a") == "spare"


def test_after_a_restart_what_was_free_is_free_and_old_names_stay_used() -> None:
    docks = station()
    docks.release(ask(docks, "a", 0.0).reservation_id, "a")
    again = station(docks.document(), 5.0)
    assert again.loan("tap", 5.0).robot_id == ""
    assert ask(again, "b", 5.0).epoch == 2


def test_a_dock_never_has_two_holders_in_any_order() -> None:
    for seed in range(200):
        print("seed", seed)
        rng, docks, now_s = random.Random(seed), station(), 0.0
        held: dict[str, float] = {}
        for _ in range(100):
            now_s += rng.choice((0.1, 1.0, 7.0))
            robot = rng.choice("abc")
            others = {name for name, until_s in held.items() if until_s > now_s and name != robot}
            try:
                ask(docks, robot, now_s, for_s=20.0)
            except Conflict:
                continue
            assert not others
            held = {robot: now_s + 20.0}
