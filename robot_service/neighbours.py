"""What other robots tell of themselves: polled once a second from 1-hop neighbours while anybody moves."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field

from core.allocation.right_of_way import Other
from core.clock import Clock
from core.errors import GardenError
from core.geometry.planar import Pose, distance_m
from core.mesh.client import Mesh
from core.mesh.peers import Peers
from core.wire.robot import Position

MOVING_EVERY_S = 1.0
NEAR_EVERY_S = 0.5
NEAR_M = 1.6
STILL_EVERY_S = 5.0
IDLE_EVERY_S = 30.0
ANSWER_S = 0.5
"""An answer that takes longer is not waited for before the next question."""
POLLS_MAX = 4
"""Questions under way at once."""
ASKED_EVERY_S = 5.0
"""Somebody who asks for our position is about to move: ask back, but not more often than this."""


@dataclass(slots=True)
class Heard:
    position: Position
    at_s: float


@dataclass(slots=True)
class Neighbours:
    """The newest word of every neighbour. One that fell silent stays where it was."""

    me: str
    peers: Peers
    mesh: Mesh
    clock: Clock
    moving: Callable[[], bool]
    pose: Callable[[], Pose | None]
    idle: Callable[[], bool] = lambda: False
    """Nothing to do, so that we shall not move before somebody asks us to."""
    heard: dict[str, Heard] = field(default_factory=dict)
    _asked_s: float = -1e9
    _wake: asyncio.Event = field(default_factory=asyncio.Event)
    _stirred: asyncio.Event = field(default_factory=asyncio.Event)

    async def run(self) -> None:
        """Ask again and again, for ever; a word that was lost keeps nobody from asking anew."""
        asking: set[asyncio.Task[None]] = set()
        async with asyncio.TaskGroup() as group:
            while True:
                if len(asking) < POLLS_MAX:
                    poll = group.create_task(self.poll())
                    asking.add(poll)
                    poll.add_done_callback(asking.discard)
                    await self._until_told(poll)
                await self._pause()

    async def _until_told(self, poll: asyncio.Task[None]) -> None:
        try:
            async with self.clock.timeout(ANSWER_S):
                await asyncio.shield(poll)
        except TimeoutError:
            pass

    async def poll(self) -> None:
        """Ask every 1-hop robot now; each answer is heard as it comes."""
        robots = [peer for peer in self.peers.one_hop() if peer.kind == "robot" and peer.id != self.me]
        if not robots:
            return
        self._asked_s = asked_s = self.clock.now()
        await self.mesh.ask_all(
            robots, "GET", "/position", expect=Position, each=lambda name, answer: self._hear(name, answer, asked_s)
        )

    def _hear(self, name: str, answer: Position | GardenError, asked_s: float) -> None:
        known = self.heard.get(name)
        if known is not None and known.at_s > asked_s:
            return
        if isinstance(answer, Position) and answer.robot_id == name:
            self.heard[name] = Heard(answer, asked_s)
            if answer.moving:
                self._stirred.set()

    async def fresh(self, within_s: float = 0.5) -> None:
        """Before the first move: hear the neighbours unless that was just done."""
        if self.clock.now() - self._asked_s > within_s:
            await self.poll()
        self._wake.set()

    def asked(self) -> None:
        """Somebody asked where we are."""
        if self.clock.now() - self._asked_s > ASKED_EVERY_S:
            self._wake.set()

    async def stir(self, within_s: float) -> None:
        """Returns when news of a moving neighbour comes, or after `within_s`."""
        self._stirred.clear()
        try:
            async with self.clock.timeout(within_s):
                await self._stirred.wait()
        except TimeoutError:
            pass

    async def _pause(self) -> None:
        self._wake.clear()
        try:
            async with self.clock.timeout(self._every_s()):
                await self._wake.wait()
        except TimeoutError:
            pass

    def calm(self) -> bool:
        """Nobody moves, as far as we have heard."""
        return not any(heard.position.moving for heard in self.heard.values())

    def _every_s(self) -> float:
        mine = self.moving()
        if not mine and self.calm():
            return IDLE_EVERY_S if self.idle() else STILL_EVERY_S
        pose = self.pose()
        near = pose is not None and any(
            distance_m(pose, (h.position.pose.x_m, h.position.pose.y_m)) < NEAR_M for h in self.heard.values()
        )
        return NEAR_EVERY_S if mine and near else MOVING_EVERY_S

    def others(self) -> list[Other]:
        """Everybody as last heard, with the age of the word."""
        now_s = self.clock.now()
        return [_other(heard, now_s) for heard in self.heard.values()]


def _other(heard: Heard, now_s: float) -> Other:
    said = heard.position
    return Other(
        robot_id=said.robot_id,
        x_m=said.pose.x_m,
        y_m=said.pose.y_m,
        v_mps=said.v_mps,
        moving=said.moving,
        docked=bool(said.docked_at),
        rank=said.rank,
        route=tuple((point.x_m, point.y_m) for point in said.route),
        age_s=now_s - heard.at_s,
    )
