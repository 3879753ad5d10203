"""Passing neighbours' parcels on, and answering those that are for this node.

One flood costs at most two messages a link: every node hands a parcel on once, to those it has not come from. Answers come
back as answers of the same requests, so that a relay keeps nothing but what it has seen lately. Everything is bounded: hops,
sizes, parcels at work, floods of one author.
"""

from __future__ import annotations

import asyncio
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import structlog
from starlette.responses import Response

from core.clock import Clock
from core.errors import Forbidden, GardenError, PeerDown, Unauthorised, Unavailable, Unprocessable
from core.mesh import inside
from core.mesh.auth import Caller, Identity, Verifier
from core.mesh.chassis import allow, body, serve_direct
from core.mesh.client import Answer, Mesh, PeerTransport, read
from core.mesh.introduction import ROLE_OF, Introducer
from core.mesh.metrics import Reading, measure
from core.mesh.parcels import (
    ANSWERS_MAX,
    BODY_BYTES_MAX,
    HOPS_MAX,
    LIFE_S,
    PATH,
    Parcel,
    ParcelAnswer,
    ParcelAnswers,
    Question,
    opened,
    packed,
    sealed_answer,
)
from core.mesh.peers import Peer, Peers

if TYPE_CHECKING:
    from fastapi import FastAPI

AT_ONCE_MAX = 128
"""Parcels under way here at once,"""
OF_ONE_MAX = 32
"""and of those, from one neighbour."""
SEEN_MAX = 4096
ACTED_MAX = 2048
WORKS_MAX = 64
"""So many of the newest answers are at hand for a copy that comes by another way."""
OPENED_MAX = 32
"""Copies of one flood follow each other closely: each seal is looked at once."""
WORK_WITHIN_S = 10.0
FLOODS_HZ, FLOODS_BURST = 4.0, 20.0
"""Of one author."""
MISSES_MAX = 2
"""A neighbour that stays silent so many times in a row is passed nothing on, until it is looked for and answers."""
ANSWERS_BYTES_MAX = 1024 * 1024
ASKED_KINDS = frozenset(ROLE_OF)
_log = structlog.get_logger("garden.parcels")


class Memory:
    """Keys of what came lately. None is forgotten while its seal is good: whoever repeats it is known."""

    def __init__(self, size: int) -> None:
        self._size = size
        self._until_s: OrderedDict[tuple[str, str], float] = OrderedDict()

    def __contains__(self, key: tuple[str, str]) -> bool:
        return key in self._until_s

    def keep(self, key: tuple[str, str], now_s: float) -> None:
        """Raises Unavailable when it is full."""
        while self._until_s and next(iter(self._until_s.values())) < now_s:
            self._until_s.popitem(last=False)
        if len(self._until_s) >= self._size:
            raise Unavailable("too many parcels came lately", hint="try again in a minute")
        self._until_s[key] = now_s + 2 * LIFE_S


class Allowance:
    """How many floods each author may still begin."""

    def __init__(self) -> None:
        self._left: dict[str, tuple[float, float]] = {}

    def spend(self, author: str, now_s: float) -> None:
        """Raises Unavailable when it has had its share."""
        left, at_s = self._left.get(author, (FLOODS_BURST, now_s))
        left = min(FLOODS_BURST, left + FLOODS_HZ * max(0.0, now_s - at_s))
        if left < 1.0:
            raise Unavailable(f"{author} floods too often", hint=f"{FLOODS_HZ:g} floods a second are passed on")
        self._left[author] = left - 1.0, now_s


class Relay:
    """One node's part: `join` gives it an app, its loop `run` its life. `transport` reaches neighbours only."""

    def __init__(
        self, hops: int, peers: Peers, verifier: Verifier, identity: Identity | None, transport: PeerTransport, clock: Clock
    ) -> None:
        """`hops`: nothing is passed on that has come so far (1 to HOPS_MAX)."""
        self.hops, self.peers, self.verifier, self.clock = min(hops, HOPS_MAX), peers, verifier, clock
        self.transport = transport
        self.counts: Counter[str] = Counter()
        self.missed_much: Callable[[], None] = lambda: None
        """Somebody in reach is silent."""
        self._hand = Mesh(transport, identity, clock)
        self._me: Introducer | None = None
        self._app: FastAPI | None = None
        self._born_s = 0.0
        self._misses: Counter[str] = Counter()
        self._seen, self._acted, self._floods = Memory(SEEN_MAX), Memory(ACTED_MAX), Allowance()
        self._works: OrderedDict[tuple[str, str], asyncio.Task[ParcelAnswer]] = OrderedDict()
        self._opened_lately: OrderedDict[tuple[str, str, str], Question] = OrderedDict()
        self._under_way: Counter[str] = Counter()
        self._group: asyncio.TaskGroup | None = None

    @property
    def me(self) -> Introducer:
        assert self._me is not None, "join first"
        return self._me

    def join(self, me: Introducer, app: FastAPI) -> None:
        """Be `me`: take parcels at `POST /parcels` of its app, and ask that app what they hold."""
        self._me, self._app, self._born_s = me, app, self.clock.now()
        measure(app.state.registry, self._readings)

        @app.post(PATH, summary="A neighbour passes a request on", tags=["mesh"], response_model=ParcelAnswers)
        async def parcels(caller: Caller = allow("plant", "robot"), parcel: Parcel = body(Parcel)) -> Response:
            answers = await self.take(parcel, caller)
            return Response(answers.model_dump_json(), media_type="application/json")

        serve_direct(app, "POST", PATH)

    async def run(self) -> None:
        """What parcels ask for is done as long as this runs."""
        async with asyncio.TaskGroup() as self._group:
            await asyncio.Event().wait()

    def _readings(self) -> Iterator[Reading]:
        for what, count in sorted(self.counts.items()):
            yield Reading("garden_parcels_total", "Parcels by what became of them", count, {"what": what})

    # Who is in reach

    def neighbours(self, *, all_of_them: bool = False) -> list[Peer]:
        """Peers that are asked directly, at addresses that were listed or proved; with all, also those silent of late."""
        return [
            contact.peer
            for contact in self.peers.contacts()
            if contact.in_reach and contact.present and contact.peer.kind in ASKED_KINDS and contact.peer.id != self.me.id
            if all_of_them or (not contact.way and self._misses[contact.peer.id] < MISSES_MAX)
        ]

    def reached(self, id: str) -> None:
        self._misses.pop(id, None)

    def missed(self, id: str) -> None:
        if self.peers.contact(id) is None:
            return
        self._misses[id] += 1
        if self._misses[id] == MISSES_MAX:
            self.missed_much()

    def learn(self, peer: Peer, way: tuple[str, ...]) -> None:
        """Its sealed word came along this way. The shortest that works is kept."""
        first = self.peers.contact(way[0])
        if peer.id == self.me.id or first is None or not first.in_reach:
            return
        known, now_s = self.peers.contact(peer.id), self.clock.now()
        if known is not None and known.present:
            if known.in_reach and len(way) > 1 and self._misses[peer.id] < MISSES_MAX:
                return
            if known.way and len(known.way) < len(way):
                known.seen_s = None if known.seen_s is None else now_s
                return
        if self.peers.heard(peer, way, now_s):
            _log.info("found a peer", peer=peer.id, way=way)

    # Parcels of others

    async def take(self, parcel: Parcel, hop: Caller) -> ParcelAnswers:
        """What neighbours and this node answer; raises what the parcel is refused for."""
        try:
            return ParcelAnswers(answers=await self._take(parcel, hop))
        except GardenError:
            self.counts["refused"] += 1
            raise

    async def _take(self, parcel: Parcel, hop: Caller) -> list[ParcelAnswer]:
        if parcel.via[-1] != hop.subject:
            raise Forbidden(f"{hop.subject} hands over what {parcel.via[-1]} should", hint="name yourself last in `via`")
        if len(parcel.via) + len(parcel.way or ()) > self.hops:
            raise Unprocessable(f"this parcel goes farther than {self.hops} hops", hint="GARDEN_FLOOD_HOPS is the limit")
        question = self._opened(parcel)
        if self.me.id in parcel.via:
            self.counts["again"] += 1
            return []
        if parcel.way is None and not self._first(question):
            self.counts["again"] += 1
            if question.to != self.me.id:
                return []
        self.learn(question.sender, tuple(reversed(parcel.via)))
        with self._place(hop.subject):
            return await self._answers(parcel, question)

    def _opened(self, parcel: Parcel) -> Question:
        """Raises Unprocessable: it is not the token of whoever hands it over that is wrong."""
        sealed = parcel.seal, parcel.body, parcel.via[0]
        now_s = self.clock.now()
        if (known := self._opened_lately.get(sealed)) is not None and abs(now_s - known.at_s) <= LIFE_S:
            return known
        try:
            question = opened(parcel, self.verifier, now_s, self._born_s)
        except Unauthorised as error:
            raise Unprocessable(f"nobody of this garden asks this: {error}", hint=error.hint) from error
        self._opened_lately[sealed] = question
        if len(self._opened_lately) > OPENED_MAX:
            self._opened_lately.popitem(last=False)
        return question

    def _first(self, question: Question) -> bool:
        """Whether this flood has not been here yet; raises Unavailable.

        Whom alone it is for answers every copy, with the same answer: the way of the first may have broken behind it.
        """
        if question.key in self._seen:
            return False
        now_s = self.clock.now()
        self._floods.spend(question.sender.id, now_s)
        self._seen.keep(question.key, now_s)
        return True

    @contextmanager
    def _place(self, hop: str) -> Iterator[None]:
        """Room for one more; raises Unavailable."""
        if self._under_way.total() >= AT_ONCE_MAX or self._under_way[hop] >= OF_ONE_MAX:
            raise Unavailable("too many parcels are under way here", hint="try again in a moment")
        self._under_way[hop] += 1
        try:
            yield
        finally:
            self._under_way[hop] -= 1

    async def _answers(self, parcel: Parcel, question: Question) -> list[ParcelAnswer]:
        """Ours and those from beyond, at once."""
        found: list[ParcelAnswer] = []
        async with asyncio.TaskGroup() as group:
            if question.is_for(self.me.id, ROLE_OF[self.me.kind]) and not parcel.way:
                group.create_task(self._add_own(parcel, question, found))
            if question.to != self.me.id:
                onward = parcel.model_copy(update={"via": [*parcel.via, self.me.id]})
                group.create_task(self.pass_on(onward, parcel.within_s, found.extend))
        return _bounded(found)

    async def _add_own(self, parcel: Parcel, question: Question, found: list[ParcelAnswer]) -> None:
        try:
            async with asyncio.timeout(parcel.within_s):
                told = await asyncio.shield(self._work(question))
        except TimeoutError:
            return
        except Unavailable:
            self.counts["refused"] += 1
            return
        found.append(told.model_copy(update={"way": [*parcel.via[1:], self.me.id]}))

    def _work(self, question: Question) -> asyncio.Task[ParcelAnswer]:
        """What it asks for, begun once: a copy that came by another way waits for the same. Raises Unavailable."""
        if (known := self._works.get(question.key)) is not None:
            return known
        while len(self._works) >= WORKS_MAX and next(iter(self._works.values())).done():
            self._works.popitem(last=False)
        if question.key in self._acted or len(self._works) >= WORKS_MAX or self._group is None:
            raise Unavailable("this was answered before, or there is too much to answer", hint="send it anew")
        self._acted.keep(question.key, self.clock.now())
        self._works[question.key] = work = self._group.create_task(self._own(question))
        return work

    async def _own(self, question: Question) -> ParcelAnswer:
        assert self._app is not None
        self.counts["answered"] += 1
        answer: Answer = await inside.ask(
            self._app, question.caller, question.method, question.path, question.headers, question.body,
            within_s=WORK_WITHIN_S, bytes_max=BODY_BYTES_MAX,
        )  # fmt: skip
        return ParcelAnswer(seal=sealed_answer(self.me, question, answer), body=packed(answer.body), way=[self.me.id])

    # Handing over

    async def pass_on(
        self,
        parcel: Parcel,
        within_s: float,
        take: Callable[[list[ParcelAnswer]], None],
        *,
        all_of_them: bool = False,
    ) -> None:
        """Hand a parcel to whoever is next; `parcel.via` ends with this node. `take` gets each neighbour's answers.

        Each hop keeps an equal part of the time for itself, so that an answer is there before whoever waits has gone.
        """
        made = len(parcel.via) - 1
        if parcel.way is None:
            legs = min(parcel.hops_left, self.hops - made)
            to = [peer for peer in self.neighbours(all_of_them=all_of_them) if peer.id not in parcel.via] if legs > 0 else []
            after: dict[str, Any] = {"hops_left": legs - 1}
        else:
            legs = len(parcel.way)
            to = [peer for peer in self.neighbours(all_of_them=True) if peer.id in parcel.way[:1]]
            after = {"way": parcel.way[1:]}
        if not to:
            return
        share_s = within_s / (legs + 1)
        content = parcel.model_copy(update=after | {"within_s": share_s * legs}).model_dump_json().encode()
        async with asyncio.TaskGroup() as group:
            for peer in to:
                group.create_task(self._hand_over(peer, content, share_s * (legs + 0.5), take))

    async def _hand_over(
        self, peer: Peer, content: bytes, within_s: float, take: Callable[[list[ParcelAnswer]], None]
    ) -> None:
        self.counts["handed_over"] += 1
        try:
            answer = await self._hand.exchange(peer, "POST", PATH, content, timeout_s=within_s)
            told = read(peer, answer, ParcelAnswers)
        except PeerDown:
            self.counts["unheard"] += 1
            return self.missed(peer.id)
        except GardenError as error:
            _log.info("a neighbour refused a parcel", peer=peer.id, why=str(error))
            return self.reached(peer.id)
        self.reached(peer.id)
        take(told.answers)


def _bounded(answers: list[ParcelAnswer]) -> list[ParcelAnswer]:
    """As many as one node hands back."""
    kept, taken = [], 0
    for answer in answers[:ANSWERS_MAX]:
        taken += len(answer.body) + len(answer.seal)
        if taken > ANSWERS_BYTES_MAX:
            break
        kept.append(answer)
    return kept
