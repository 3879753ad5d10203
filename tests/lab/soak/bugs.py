"""Mistakes that somebody could make, each as a patch of a real service: the soak must find every one."""

from __future__ import annotations

import asyncio
import json
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any
from unittest import mock

from core import store
from core.allocation import tasks
from core.allocation.epochs import Names
from core.allocation.plant_side import Market
from core.allocation.plant_state import MarketDocument
from core.allocation.queue import Entry, TaskQueue
from core.allocation.tasks import TaskBook
from core.allocation.watering import Watering
from core.errors import StorageError, Unprocessable
from core.mesh.client import Mesh
from plant_service.inventory import Fruits
from plant_service.market import Marketplace
from robot_service.body import gate
from robot_service.body.caps import StopLatch
from robot_service.body.pump import Doser
from robot_service.brain import Brain
from robot_service.scheduler import Scheduler

BUGS: dict[str, Callable[[], Any]] = {}


def bug(plant: Callable[[], Iterator[None]]) -> Callable[[], Any]:
    BUGS[plant.__name__] = contextmanager(plant)
    return BUGS[plant.__name__]


@bug
def permit_for_any_epoch():
    """The plant does not look who holds the task before it gives a permit."""
    real = Market._check_permit

    def careless(self, task, request, now_s):
        mine = task.model_copy(update={"robot_id": request.robot_id, "epoch": request.epoch, "state": "awarded"})
        self._live[task.task_id].lease_until_s = math.inf
        real(self, mine, request, now_s)

    with mock.patch.object(Market, "_check_permit", careless):
        yield


@bug
def acknowledged_before_fsync():
    with mock.patch.object(store, "_fsync", return_value=None):
        yield


@bug
def a_full_disk_is_a_success():
    """A write that failed is acknowledged."""
    real = store.DurableDocument.commit

    def hopeful(self, doc):
        try:
            return real(self, doc)
        except StorageError:
            return self.generation

    with mock.patch.object(store.DurableDocument, "commit", hopeful):
        yield


@bug
def an_award_is_queued_again():
    """The robot takes the same award every time it comes."""

    def greedy(self, award, now_s, at=None):
        return self._take(None, award, now_s, at)

    with mock.patch.object(TaskQueue, "award", greedy):
        yield


@bug
def a_permit_for_every_request():
    """The plant gives another permit when asked again."""

    def permit(self, task_id, request, key, now_s):
        task = self.task(task_id)
        self._water.open = None
        self._check_permit(task, request, now_s)
        act = self._dose if request.act == "water" else self._pick
        return act(task, request, key, now_s)

    with mock.patch.object(Market, "permit", permit):
        yield


@bug
def a_permit_is_forgotten_in_a_restart():
    real = Market.document

    def document(self):
        return real(self).model_copy(update={"open_permit": None})

    with mock.patch.object(Market, "document", document):
        yield


@bug
def the_robot_counts_on_a_longer_lease():
    """It reports a quarter of twenty leases apart."""
    real = TaskQueue._take

    def patient(self, held, award, now_s, at=None):
        return real(self, held, award.model_copy(update={"lease_s": 20 * award.lease_s}), now_s, at)

    with mock.patch.object(TaskQueue, "_take", patient):
        yield


@bug
def a_kill_is_ignored():
    def deaf(self, entry: Entry, why: str) -> None:
        return None

    with mock.patch.object(Scheduler, "kill", deaf):
        yield


@bug
def the_wall_clock_is_used():
    """Events of the market are stamped by another clock than its ticks."""

    async def change(self, event):
        try:
            return await self._keeper.change(lambda market: event(market, asyncio.get_running_loop().time()))
        finally:
            self._wake.set()

    with mock.patch.object(Marketplace, "change", change):
        yield


@bug
def an_award_leaves_before_it_is_on_disk():
    async def hasty(self, group):
        market = self._keeper.machine
        market.tick(self._clock.now(), [peer.id for peer in self._peers.of_kind("robot")])
        for effect in market.take_effects():
            self._carry_out(effect, group)
        await self._clock.sleep(0.05)
        try:
            await self._keeper.settle()
        except StorageError:
            await self._clock.sleep(5.0)

    with mock.patch.object(Marketplace, "_round", hasty):
        yield


@bug
def a_repeated_award_is_keyed_and_differs():
    """An award goes out under an Idempotency-Key; sent again after a restart, its words are others, and it is refused."""
    real = Mesh.exchange

    async def exchange(self, peer, method, path, body=b"", *, key="", **more):
        if method == "POST" and path == "/tasks":
            award = json.loads(body)
            key = f"{award['announcement']['task_id']}/{award['epoch']}"
        return await real(self, peer, method, path, body, key=key, **more)

    with mock.patch.object(Mesh, "exchange", exchange):
        yield


@bug
def a_kill_is_not_understood():
    """The robot refuses a word of the protocol that it does not know."""

    def kill(self, task_id, caller, epoch=None):
        raise Unprocessable("no query parameter 'epoch'")

    with mock.patch.object(Brain, "kill", kill):
        yield


@bug
def an_epoch_is_used_again():
    """A task that is awarded anew keeps its epoch."""
    real = TaskBook._award

    def award(self, task, robot_id, cost_s, bids, why, now_s):
        real(self, task.model_copy(update={"epoch": max(0, task.epoch - 1)}), robot_id, cost_s, bids, why, now_s)

    with mock.patch.object(TaskBook, "_award", award):
        yield


@bug
def the_first_bid_wins():
    with mock.patch.object(tasks, "cheapest", lambda bids: max(bids, key=lambda bid: bid.cost_s or -1.0, default=None)):
        yield


@bug
def the_soil_is_not_awaited():
    """A dose is settled by the very next reading."""
    real = Watering.measured

    def hasty(self, soil, now_s):
        self.settle_at_s = min(self.settle_at_s, soil.stamp_s)
        return real(self, soil, now_s)

    with mock.patch.object(Watering, "measured", hasty):
        yield


@bug
def an_old_reading_tells_of_a_new_dose():
    """What the probe said before it fell silent counts as measured now."""
    real = Watering.measured

    def credulous(self, soil, now_s):
        return real(self, replace(soil, stamp_s=now_s), now_s)

    with mock.patch.object(Watering, "measured", credulous):
        yield


@bug
def a_permit_lasts_for_ever():
    """The robot does not look how old its permit is."""
    from robot_service.skills import water as skill

    real = skill._pour

    async def pour(robot, permit, asked_s, poured):
        await real(robot, permit.model_copy(update={"valid_for_s": 1e9}), asked_s, poured)

    with mock.patch.object(skill, "_pour", pour):
        yield


@bug
def a_command_lives_for_ever():
    """The gate lets wheels and pump go on while the brain sleeps."""
    with mock.patch.object(gate, "LIFE_S", 1e9):
        yield


@bug
def the_estop_is_forgotten_in_a_restart():
    real = StopLatch.load

    def load(self):
        real(self)
        self.stopped, self.by = False, ""

    with mock.patch.object(StopLatch, "load", load):
        yield


@bug
def ids_begin_anew_with_every_boot():
    real = Names.__init__

    def named(self, owner, boot):
        real(self, owner, 1)

    with mock.patch.object(Names, "__init__", named):
        yield


@bug
def a_picked_fruit_stays_in_the_inventory():
    with mock.patch.object(Fruits, "picked", return_value=[]):
        yield


@bug
def a_restarted_plant_trusts_an_old_permit_time():
    """An open permit's time counts from the clock of before, which was another one."""
    real = MarketDocument.by_clock

    def trusting(self, now_s):
        return real(self, now_s).model_copy(update={"open_permit": self.open_permit})

    with mock.patch.object(MarketDocument, "by_clock", trusting):
        yield


@bug
def a_spent_permit_pours_again():
    """The body does not remember what it let out under a permit."""
    real = Doser.delivered_ml

    def forgetful(self, now_s):
        return 0.4 * real(self, now_s)

    with mock.patch.object(Doser, "delivered_ml", forgetful):
        yield


@bug
def an_estop_is_confirmed_before_it_is_written_down():
    real = StopLatch.press

    def press(self, by):
        real(self, by)
        self.kept = True

    with mock.patch.object(StopLatch, "press", press):
        yield


@bug
def a_release_said_again_releases_a_later_stop():
    """Neither brain nor body looks at which stop is meant."""
    real = StopLatch.release

    async def release(self, number):
        return await real(self, self._number)

    with mock.patch.object(StopLatch, "release", release), mock.patch.object(Brain, "_check_stop"):
        yield
