"""Asking peers beyond one hop: a way where one is known, a flood where none is, and looking around for who is there."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from random import Random
from typing import TYPE_CHECKING

import structlog

from core.errors import GardenError
from core.mesh.client import Answer
from core.mesh.introduction import Introducer
from core.mesh.parcels import BODY_BYTES_MAX, EVERYBODY, WITHIN_S_MAX, Parcel, ParcelAnswer, opened_answer, packed, sealed
from core.mesh.peers import FLOOD, Contact, Peer
from core.mesh.relay import Relay

if TYPE_CHECKING:
    from fastapi import FastAPI

AGAIN_S = 20.0
"""Looking around again,"""
SOON_S = 3.0
"""and when something is new, or somebody in reach has fallen silent."""
LOOK_WITHIN_S = 3.0
LOST_S = 3.5 * AGAIN_S
WAY_SHARE = 0.55
"""Of the time for an answer: what is left is for a flood, when the way is broken."""
FLOOD_AGAIN_S = 1.0
"""Somebody whom no flood found is looked for again."""
_log = structlog.get_logger("garden.parcels")


class Courier:
    """A PeerTransport and Carrier over a relay's neighbours."""

    def __init__(self, relay: Relay, rng: Random) -> None:
        self._relay, self._rng = relay, rng
        self._number = 0
        self._unfound_s: dict[str, float] = {}
        self._stirred = asyncio.Event()
        relay.missed_much = self._stirred.set
        relay.peers.sources = (*relay.peers.sources, FLOOD)

    def join(self, me: Introducer, app: FastAPI) -> list[Callable[[], Awaitable[None]]]:
        """Be `me` at `app`; the loops to run."""
        self._relay.join(me, app)
        return [self._relay.run, self.run]

    async def send(self, method: str, url: str, headers: Mapping[str, str], body: bytes) -> Answer:
        """Straight to somebody in reach."""
        return await self._relay.transport.send(method, url, headers, body)

    async def aclose(self) -> None:
        await self._relay.transport.aclose()

    # Asking

    async def carry(
        self, peer: Peer, method: str, path: str, headers: Mapping[str, str], body: bytes, within_s: float
    ) -> Answer:
        """Straight to whoever is in reach; nobody else is ever sent a token. Raises OSError when nobody answers."""
        contact = self._relay.peers.contact(peer.id)
        if contact is not None and (contact.way or not contact.in_reach):
            return await self._by_parcel(contact, method, path, headers, body, within_s)
        try:
            answer = await self.send(method, peer.url + path, headers, body)
        except (OSError, asyncio.CancelledError):
            self._relay.missed(peer.id)
            raise
        self._relay.reached(peer.id)
        return answer

    async def _by_parcel(
        self, contact: Contact, method: str, path: str, headers: Mapping[str, str], body: bytes, within_s: float
    ) -> Answer:
        """Along the way; when that is broken, or there is none, the same request as a flood: it is done once."""
        id, began_s = contact.peer.id, asyncio.get_running_loop().time()
        number, parcel = self._parcel(id, method, path, headers, body, within_s)
        if way := contact.way:
            self._relay.counts["sent"] += 1
            along = parcel.model_copy(update={"way": list(way)})
            if (answer := await self._first(id, number, along, within_s * WAY_SHARE)) is not None:
                return answer
            self._relay.counts["ways_lost"] += 1
            if contact.way == way:
                contact.way = ()
        left_s = within_s - (asyncio.get_running_loop().time() - began_s)
        if left_s > 0 and self._may_look(id):
            self._relay.counts["flooded"] += 1
            if (answer := await self._first(id, number, parcel, left_s)) is not None:
                return answer
            self._unfound_s[id] = self._relay.clock.now()
        raise ConnectionError(f"no way of {self._relay.hops} hops leads to it")

    def _may_look(self, id: str) -> bool:
        return self._relay.clock.now() - self._unfound_s.get(id, -1e9) >= FLOOD_AGAIN_S

    async def flood(
        self,
        to: str,
        method: str,
        path: str,
        headers: Mapping[str, str],
        body: bytes,
        within_s: float,
        heard: Callable[[Peer, Answer], None],
        *,
        all_of_them: bool = False,
    ) -> None:
        """Ask all that `to` means (`client.ROBOTS`, `EVERYBODY`), within the limit of hops; each is heard once.

        With `all_of_them` also by way of neighbours that were silent lately.
        """
        number, parcel = self._parcel(to, method, path, headers, body, within_s)
        self._relay.counts["flooded"] += 1
        known: set[str] = set()

        def take(told: list[ParcelAnswer]) -> None:
            for peer, answer in self._read(told, number):
                if peer.id not in known:
                    known.add(peer.id)
                    heard(peer, answer)

        await self._relay.pass_on(parcel, within_s, take, all_of_them=all_of_them)

    async def _first(self, id: str, number: str, parcel: Parcel, within_s: float) -> Answer | None:
        """The addressee's answer as soon as it is there."""
        got: asyncio.Future[Answer] = asyncio.get_running_loop().create_future()

        def take(told: list[ParcelAnswer]) -> None:
            for peer, answer in self._read(told, number):
                if peer.id == id and not got.done():
                    got.set_result(answer)

        asking = asyncio.ensure_future(self._relay.pass_on(parcel, within_s, take))
        try:
            await asyncio.wait((asking, got), return_when=asyncio.FIRST_COMPLETED)
            if asking.done():
                asking.result()
        finally:
            asking.cancel()
        return got.result() if got.done() else None

    def _parcel(
        self, to: str, method: str, path: str, headers: Mapping[str, str], body: bytes, within_s: float
    ) -> tuple[str, Parcel]:
        """Sealed, and its number; raises OSError for what does not fit into one."""
        if len(body) > BODY_BYTES_MAX:
            raise ConnectionError(f"{len(body)} bytes do not fit into a parcel")
        relay, now_s = self._relay, self._relay.clock.now()
        self._number += 1
        number = f"{now_s:.6f}-{self._number}"
        seal = sealed(relay.me, number, to, method, path, headers, body, now_s)
        within_s = min(within_s, WITHIN_S_MAX)
        return number, Parcel(seal=seal, body=packed(body), via=[relay.me.id], hops_left=relay.hops, within_s=within_s)

    def _read(self, told: list[ParcelAnswer], number: str) -> list[tuple[Peer, Answer]]:
        """Those that are true answers to this question; their ways are learnt."""
        relay, read = self._relay, []
        for each in told:
            try:
                peer, answer = opened_answer(each, (relay.me.id, number), relay.verifier, relay.clock.now())
            except GardenError as error:
                relay.counts["forged"] += 1
                _log.warning("an answer that nobody gave", way=each.way, why=str(error))
                continue
            relay.learn(peer, tuple(each.way))
            read.append((peer, answer))
        return read

    # Looking around

    async def run(self) -> None:
        """Ask everybody for a sign of life, for ever: often while something is new, then less and less."""
        pause_s = SOON_S
        while True:
            self._stirred.clear()
            before = self._present()
            await self.look_around()
            pause_s = SOON_S if self._present() != before else min(AGAIN_S, 2 * pause_s)
            await self._relay.clock.sleep(SOON_S)
            try:
                async with self._relay.clock.timeout(max(0.0, pause_s * (0.8 + 0.4 * self._rng.random()) - SOON_S)):
                    await self._stirred.wait()
            except TimeoutError:
                pass

    def _present(self) -> set[str]:
        return {contact.peer.id for contact in self._relay.peers.contacts() if contact.present}

    async def look_around(self) -> None:
        """One flood to everybody, also by neighbours that were silent; whoever was not heard for long is lost."""
        await self.flood(EVERYBODY, "GET", "/healthz", {}, b"", LOOK_WITHIN_S, lambda peer, answer: None, all_of_them=True)
        peers, now_s = self._relay.peers, self._relay.clock.now()
        for contact in peers.contacts():
            if contact.source == FLOOD and now_s - (contact.seen_s or 0.0) > LOST_S and peers.lost(contact.peer.id):
                _log.info("lost a peer", peer=contact.peer.id, source=FLOOD)
