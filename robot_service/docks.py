"""Holding docks: a dock is its owner's, and a robot reserves it before it comes near."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field

from core.clock import Clock
from core.errors import Conflict, GardenError, NotFound, PeerDown, Refused
from core.mesh.client import Mesh
from core.mesh.peers import Peers
from core.robots.garden_map import KnownDock
from core.wire.documents import Document
from core.wire.market import Reservation, ReservationRequest

HOLD_FOR_S = 30.0
RENEW_S = 8.0
REST_FOR_S = 60.0
"""Who only rests on a dock holds it longer and asks less often: should it die there, it blocks the dock anyway."""
RENEW_RESTING_S = 24.0
"""Renewing tells us that somebody waits, and nobody can while all neighbours stand still."""


@dataclass(slots=True)
class Hold:
    dock: KnownDock
    reservation: Reservation
    until_s: float
    yielding: bool = False
    lost: str = ""
    """Why it is no longer ours; empty while it is."""

    @property
    def wanted_by(self) -> str:
        return self.reservation.wanted_by


@dataclass(slots=True)
class Docks:
    """The docks this robot holds. `run` renews them."""

    me: str
    mesh: Mesh
    peers: Peers
    clock: Clock
    calm: Callable[[], bool] = lambda: False
    """No neighbour moves, as far as we have heard."""
    holds: dict[str, Hold] = field(default_factory=dict)
    _news: asyncio.Event = field(default_factory=asyncio.Event)

    async def news(self, within_s: float) -> None:
        """Returns when a dock of ours is wanted or lost, or after `within_s`."""
        self._news.clear()
        try:
            async with self.clock.timeout(within_s):
                await self._news.wait()
        except TimeoutError:
            pass

    async def ask(self, dock: KnownDock, *, yielding: bool = False) -> str:
        """Reserve or renew; empty when granted, else the reason."""
        owner = self.peers.find(dock.owner)
        if owner is None:
            return f"nobody known owns dock {dock.name}"
        for_s = REST_FOR_S if yielding else HOLD_FOR_S
        wish = ReservationRequest(robot_id=self.me, dock_id=dock.dock_id, for_s=for_s, yielding=yielding)
        asked_s = self.clock.now()
        try:
            granted = await self.mesh.call(owner, "POST", "/dock/reservations", wish, expect=Reservation)
        except (Conflict, Refused) as error:
            self._lose(dock.name, str(error))
            return str(error)
        except GardenError as error:
            if (hold := self.holds.get(dock.name)) and self.clock.now() > hold.until_s:
                self._lose(dock.name, str(error))
            return f"cannot reserve {dock.name}: {error}"
        self._grant(dock, granted, asked_s + granted.valid_for_s, yielding)
        return ""

    def _grant(self, dock: KnownDock, granted: Reservation, until_s: float, yielding: bool) -> None:
        if (hold := self.holds.get(dock.name)) is None:
            self.holds[dock.name] = Hold(dock, granted, until_s, yielding)
        else:
            hold.reservation, hold.until_s, hold.yielding, hold.lost = granted, until_s, yielding, ""
        if granted.wanted_by:
            self._news.set()

    def _lose(self, name: str, why: str) -> None:
        if (hold := self.holds.get(name)) is not None:
            hold.lost = why
            self._news.set()

    def held(self, name: str) -> bool:
        """Ours, and not run out."""
        hold = self.holds.get(name)
        return hold is not None and not hold.lost and self.clock.now() < hold.until_s

    async def release(self, name: str) -> None:
        """Give it back; when its owner does not answer, the reservation runs out by itself."""
        hold = self.holds.pop(name, None)
        if hold is None or hold.lost or (owner := self.peers.find(hold.dock.owner)) is None:
            return
        try:
            path = f"/dock/reservations/{hold.reservation.reservation_id}"
            await self.mesh.exchange(owner, "DELETE", path)
        except (PeerDown, NotFound):
            return

    async def release_others(self, name: str = "") -> None:
        """Give back all but `name`: one whose dock we left in no orderly way would be renewed for ever."""
        for other in [held for held in self.holds if held != name]:
            await self.release(other)

    async def run(self) -> None:
        """Renew what is held, for ever."""
        while True:
            await self.clock.sleep(RENEW_S)
            for hold in list(self.holds.values()):
                if self.holds.get(hold.dock.name) is hold and not self._may_wait(hold):
                    await self.ask(hold.dock, yielding=hold.yielding)

    def _may_wait(self, hold: Hold) -> bool:
        """A rest that nobody can want to end is renewed seldom, yet with time for a second and a third attempt."""
        left_s = hold.until_s - self.clock.now()
        return hold.yielding and not hold.lost and left_s > REST_FOR_S - RENEW_RESTING_S + 1.0 and self.calm()


class Nothing(Document):
    """An empty answer."""
