"""The robot's queue takes nothing twice and nothing stale."""

import math

import pytest

from core.allocation.queue import EPOCHS_KEPT, QUEUE_MAX, Entry, TaskQueue
from core.errors import NotFound, Refused
from core.wire.geometry import Point3, Pose2
from core.wire.market import Announcement, Award, PlantCard

CARD = PlantCard(
    plant_id="plant-1",
    url="http://x",
    stem=Point3(x_m=0.0, y_m=0.0, z_m=0.25),
    dock=Pose2(x_m=0.0, y_m=0.0, yaw_rad=0.0),
    nozzle=Point3(x_m=0.0, y_m=0.0, z_m=0.0),
)


def award(number=1, epoch=1):
    asked = Announcement(task_id=f"plant-1:{number}", kind="water", plant=CARD, dose_ml=100.0)
    return Award(announcement=asked, epoch=epoch, lease_s=8.0, cost_s=10.0)


def test_the_same_award_twice_makes_one_entry_and_renews_its_lease():
    queue = TaskQueue()
    first, again = queue.award(award(), 0.0), queue.award(award(), 5.0)
    assert first is again
    assert len(queue.entries) == 1
    assert first.lease_until_s == 13.0


def test_a_stale_epoch_is_refused_even_after_the_task_is_gone():
    queue = TaskQueue()
    queue.drop(queue.award(award(epoch=3), 0.0))
    for epoch in (1, 3):
        with pytest.raises(Refused):
            queue.award(award(epoch=epoch), 1.0)
    assert queue.award(award(epoch=4), 1.0).epoch == 4


def test_a_newer_epoch_replaces_the_older_in_place():
    queue = TaskQueue()
    queue.award(award(1), 0.0)
    queue.award(award(2), 0.0)
    queue.award(award(1, epoch=2), 1.0)
    assert [(e.task_id, e.epoch) for e in queue.entries] == [("plant-1:1", 2), ("plant-1:2", 1)]


def test_a_task_past_its_permit_is_not_taken_again_until_it_ended():
    queue = TaskQueue()
    queue.award(award(), 0.0).committed = True
    with pytest.raises(Refused):
        queue.award(award(epoch=2), 1.0)


def test_errands_of_our_own_go_in_front_of_what_has_not_begun():
    queue = TaskQueue()
    queue.award(award(1), 0.0).running = True
    queue.award(award(2), 0.0)
    queue.push(Entry(task_id="own", kind="charge"), first=True)
    assert [e.task_id for e in queue.entries] == ["plant-1:1", "own", "plant-1:2"]


def test_what_is_only_on_its_way_may_still_be_put_behind_another():
    queue = TaskQueue(may_wait=lambda entry: not entry.progress)
    first = queue.award(award(1), 0.0)
    first.running = True
    assert queue.begun is None
    queue.award(award(2), 1.0, at=0)
    assert [entry.task_id for entry in queue.waiting] == ["plant-1:2", "plant-1:1"]
    assert queue.running is first
    queue.arrange([1, 0])
    first.progress = 0.5
    assert queue.begun is first
    queue.award(award(3), 2.0, at=0)
    assert [entry.task_id for entry in queue.entries] == ["plant-1:1", "plant-1:3", "plant-1:2"]


def test_what_arrived_while_it_was_put_behind_another_is_first_again_and_nothing_is_lost():
    queue = TaskQueue(may_wait=lambda entry: not entry.progress)
    first = queue.award(award(1), 0.0)
    first.running = True
    queue.award(award(2), 1.0, at=0)
    first.progress = 0.5
    queue.award(award(3), 2.0, at=1)
    assert [entry.task_id for entry in queue.entries] == ["plant-1:1", "plant-1:2", "plant-1:3"]


def test_the_queue_is_bounded():
    queue = TaskQueue()
    for number in range(QUEUE_MAX):
        queue.award(award(number), 0.0)
    with pytest.raises(Refused, match="full"):
        queue.award(award(QUEUE_MAX), 0.0)


def test_an_unknown_task_is_not_found():
    with pytest.raises(NotFound):
        TaskQueue().get("plant-1:9")


def test_an_entry_is_what_was_awarded_and_nothing_more_yet():
    entry = TaskQueue().award(award(), 5.0)
    assert (entry.task_id, entry.kind, entry.plant_id, entry.epoch) == ("plant-1:1", "water", "plant-1", 1)
    assert (entry.lease_s, entry.lease_until_s, entry.since_s) == (8.0, 13.0, 5.0)
    assert (entry.running, entry.committed, entry.killed, entry.phase, entry.progress) == (False, False, "", "", 0.0)
    own = Entry(task_id="own", kind="charge")
    assert (own.epoch, own.lease_s, own.plant_id) == (0, 0.0, "")
    assert (own.lease_until_s, own.since_s) == (math.inf, -math.inf)


def test_a_newer_epoch_brings_its_own_lease():
    queue = TaskQueue()
    queue.award(award(), 0.0)
    longer = award(epoch=2).model_copy(update={"lease_s": 20.0})
    assert queue.award(longer, 1.0).lease_until_s == 21.0
    assert queue.entries[0].lease_s == 20.0


def test_what_was_killed_and_is_awarded_anew_is_a_new_entry():
    queue = TaskQueue()
    killed = queue.award(award(), 0.0)
    killed.killed = "moved"
    with pytest.raises(Refused, match="epoch 1"):
        queue.award(award(), 1.0)
    assert queue.award(award(epoch=2), 1.0) is not killed


def test_an_award_is_known_when_its_epoch_is_nought():
    queue = TaskQueue()
    queue.drop(queue.award(award(epoch=0), 0.0))
    with pytest.raises(Refused):
        queue.award(award(epoch=0), 1.0)


def test_the_newest_thousand_epochs_are_remembered_and_a_repeated_one_is_new_again():
    queue = TaskQueue()
    for number in range(EPOCHS_KEPT):
        queue.drop(queue.award(award(number), 0.0))
    queue.drop(queue.award(award(0, epoch=2), 0.0))
    queue.drop(queue.award(award(EPOCHS_KEPT), 0.0))
    with pytest.raises(Refused):
        queue.award(award(0, epoch=2), 1.0)
    with pytest.raises(Refused):
        queue.award(award(2), 1.0)
    assert queue.award(award(1), 1.0).task_id == "plant-1:1", "the oldest was forgotten"
    assert (QUEUE_MAX, EPOCHS_KEPT) == (32, 1000)


def test_a_full_queue_takes_no_errand_either_but_knows_what_it_has():
    queue = TaskQueue([Entry(task_id=f"e{n}", kind="job") for n in range(QUEUE_MAX - 1)])
    queue.push(Entry(task_id="last", kind="charge"))
    assert queue.entries[-1].task_id == "last"
    with pytest.raises(Refused, match="full"):
        queue.push(Entry(task_id="more", kind="job"))
    assert queue.has("charge")
    assert not queue.has("refill")
    assert queue.get("last") is queue.entries[-1]


def test_what_is_rushed_is_next_or_behind_what_runs():
    queue = TaskQueue([Entry(task_id=name, kind="inventory") for name in "abc"])
    queue.rush(queue.get("c"))
    assert [entry.task_id for entry in queue.entries] == ["c", "a", "b"]
    queue.get("c").running = True
    queue.rush(queue.get("b"))
    assert [entry.task_id for entry in queue.entries] == ["c", "b", "a"]
    assert queue.next() is queue.get("c")
    assert TaskQueue().next() is None
    queue.drop(Entry(task_id="z", kind="job"))
    assert len(queue.entries) == 3


def test_without_being_told_so_nothing_that_runs_is_put_off():
    queue = TaskQueue([Entry(task_id=name, kind="inventory", running=name == "a") for name in "ab"])
    assert queue.begun is queue.entries[0]
    queue.push(Entry(task_id="own", kind="charge"), first=True)
    assert [entry.task_id for entry in queue.entries] == ["a", "own", "b"]


def test_an_own_errand_is_first_when_nothing_runs():
    queue = TaskQueue([Entry(task_id="a", kind="inventory")])
    queue.push(Entry(task_id="own", kind="charge"), first=True)
    assert [entry.task_id for entry in queue.entries] == ["own", "a"]
