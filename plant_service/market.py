"""Carries a pot's market out: saves its state, asks robots for bids, sends awards and kill messages."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from typing import TypeVar

import structlog

from core.allocation.auction import no_bid
from core.allocation.plant_side import Market
from core.allocation.plant_state import Effect, Grant, Kill, MarketDocument, Note, Solicit
from core.clock import Clock
from core.errors import GardenError, Overtaken, PeerDown, StorageError
from core.mesh.client import ROBOTS, Answer, Mesh
from core.mesh.peers import Peers
from core.mesh.plain import check
from core.wire.documents import Problem
from core.wire.market import Bid
from plant_service.journal import Journal
from plant_service.keeper import Keeper
from plant_service.tally import Tally

T = TypeVar("T")
NAP_S_MIN = 0.01
STORAGE_NAP_S = 5.0
KILL_TRIES = 3
KILL_AGAIN_S = 1.0


class Marketplace:
    """One plant's market in the world. Effects leave only after the state that caused them is durable."""

    def __init__(
        self, keeper: Keeper[Market, MarketDocument], mesh: Mesh, peers: Peers, clock: Clock, journal: Journal
    ) -> None:
        self._keeper, self._mesh, self._peers, self._clock, self._journal = keeper, mesh, peers, clock, journal
        self._wake = asyncio.Event()
        self.tally = Tally()
        self._log = structlog.get_logger("garden.market")

    @property
    def market(self) -> Market:
        """For reading."""
        return self._keeper.machine

    @property
    def broken(self) -> str:
        return self._keeper.broken

    def configure(self, soak_s: float, day_cap_ml: float, target_ratio: float) -> None:
        """The operator's limits; they hold for the market after a storage failure, too."""
        limits = self._keeper.machine.limits
        limits.soak_s, limits.day_cap_ml, limits.target_ratio = soak_s, day_cap_ml, target_ratio

    async def change(self, event: Callable[[Market, float], T]) -> T:
        """Run one event; returns when it is durable, raises what it raised or StorageError."""
        try:
            return await self._keeper.change(lambda market: event(market, self._clock.now()))
        finally:
            self._wake.set()

    async def run(self) -> None:
        """Tick when something is due and carry out effects, for ever."""
        async with asyncio.TaskGroup() as group:
            while True:
                self._wake.clear()
                await self._round(group)
                await self._nap()

    async def _round(self, group: asyncio.TaskGroup) -> None:
        market = self._keeper.machine
        market.tick(self._clock.now(), [peer.id for peer in self._peers.of_kind("robot")])
        effects = market.take_effects()
        try:
            await self._keeper.settle()
        except StorageError as error:
            # The market is back at its durable state: what was about to leave never happened.
            self._log.error("the market cannot be saved", why=str(error))
            await self._clock.sleep(STORAGE_NAP_S)
            return
        for effect in effects:
            self._carry_out(effect, group)

    async def _nap(self) -> None:
        nap_s = self._keeper.machine.due_s() - self._clock.now()
        try:
            async with self._clock.timeout(None if nap_s == math.inf else max(nap_s, NAP_S_MIN)):
                await self._wake.wait()
        except TimeoutError:
            return

    def _carry_out(self, effect: Effect, group: asyncio.TaskGroup) -> None:
        self.tally.take(effect)
        match effect:
            case Note():
                self._journal.note(effect.kind, effect.what, task_id=effect.task_id, robot_id=effect.robot_id, **effect.data)
            case Solicit():
                group.create_task(self._solicit(effect))
            case Grant():
                group.create_task(self._grant(effect))
            case Kill():
                group.create_task(self._kill(effect))

    async def _solicit(self, ask: Solicit) -> None:
        peers = [peer for name in ask.robots if (peer := self._peers.find(name)) is not None]
        task_id = ask.announcement.task_id

        def answered(robot_id: str, answer: Bid | GardenError) -> None:
            bid = answer if isinstance(answer, Bid) else no_bid(task_id, robot_id, _silence(answer))
            self._keeper.machine.bid(task_id, ask.round_number, robot_id, bid, self._clock.now())
            self._wake.set()

        await self._mesh.ask_all(peers, "POST", "/bids", ask.announcement, expect=Bid, each=answered, flood_to=ROBOTS)

    async def _grant(self, grant: Grant) -> None:
        award = grant.award
        task_id, epoch = award.announcement.task_id, award.epoch
        # Without an Idempotency-Key: a robot knows an award by its task and epoch, and after a restart the words may differ.
        answer = await self._send(grant.robot_id, "POST", "/tasks", award.model_dump_json().encode())
        if answer is None or answer.status >= 500:
            return
        refused = "" if answer.status < 300 else _reason(answer)
        overtaken = answer.status == Overtaken.status and _problem(answer).title == Overtaken.title
        self._keeper.machine.award_answered(task_id, epoch, refused, self._clock.now(), overtaken=overtaken)
        self._wake.set()

    async def _kill(self, kill: Kill) -> None:
        for _ in range(KILL_TRIES):
            if await self._send(kill.robot_id, "DELETE", f"/tasks/{kill.task_id}?epoch={kill.epoch}") is not None:
                return
            await self._clock.sleep(KILL_AGAIN_S)

    async def _send(self, robot_id: str, method: str, path: str, body: bytes = b"") -> Answer | None:
        """The robot's answer, whatever it says; None when there was none."""
        if (peer := self._peers.find(robot_id)) is None:
            return None
        try:
            return await self._mesh.exchange(peer, method, path, body)
        except PeerDown:
            return None


def _silence(error: GardenError) -> str:
    return "did not answer" if isinstance(error, PeerDown) else f"answered {error.status}: {error}"


def _reason(answer: Answer) -> str:
    return _problem(answer).detail[:300]


def _problem(answer: Answer) -> Problem:
    """What a refusal says; a made-up one when it says nothing that we understand."""
    try:
        check(answer.body)
        return Problem.model_validate_json(answer.body)
    except ValueError:
        return Problem(title="", status=answer.status, detail=f"status {answer.status}")
