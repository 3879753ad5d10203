"""A pot's fruit: scans come in, picks are permitted and told, the ledger is kept, and the pot asks for what it lacks.

Four documents take part: the market (tasks and permits), the inventory, the ledger and nothing else in between. Whatever a
robot is answered is on disk in all of them; a process that dies between two of them finds its way by the robot's next
report, which tells every pick again, or by a scan.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from starlette.responses import Response

from core.allocation.picking import may_be_picked
from core.allocation.plant_state import Keyed
from core.clock import Clock
from core.errors import Conflict, Refused
from core.growth.forecast import forecast, uncertainty
from core.wire.fruit import Forecast, Fruit, FruitCounts, LedgerLine, Pick, Scan
from core.wire.market import Permit, PermitRequest, Report, ReportAnswer, Task, TaskRequest
from core.wire.plant import Settings
from plant_service import ledger
from plant_service.inventory import LOOK_AGAIN_S, Fruits, InventoryDocument
from plant_service.journal import Journal
from plant_service.keeper import Keeper
from plant_service.ledger import Ledger
from plant_service.market import Marketplace
from plant_service.shelf import Shelf

KEEP_RIPE, KEEP_RIPE_S = 2, 6 * 3600.0
"""So many ripe fruit are left for people who order some, for so long: a pot asks for all others to be picked at once."""
AFTER_FAILURE_S = 1800.0
OWN = "fruit"
"""Who asks when the plant asks for its fruit."""


class Tending:
    """All of a pot that is about fruit."""

    def __init__(
        self,
        fruits: Keeper[Fruits, InventoryDocument],
        shelf: Shelf,
        book: Ledger,
        place: Marketplace,
        clock: Clock,
        journal: Journal,
    ) -> None:
        self.shelf, self.ledger = shelf, book
        self._fruits, self._place, self._clock, self._journal = fruits, place, clock, journal
        self.lost: Counter[str] = Counter()
        """By colour: fruit that scans found gone and nobody told of, since the process began."""

    # What others read

    def counts(self) -> FruitCounts:
        return self._fruits.machine.counts()

    def uncertainty(self) -> float:
        """Of the inventory: 0 just scanned, 1 nothing known."""
        fruits = self._fruits.machine
        return uncertainty(fruits.outlook()[1], fruits.inventory.scanned_s, self._clock.now())

    def forecast(self, ahead_s: float) -> Forecast:
        fruits = self._fruits.machine
        pace, hopes = fruits.outlook()
        inventory = fruits.inventory
        return forecast(inventory.plant_id, hopes, pace, inventory.scanned_s, self._clock.now(), ahead_s)

    def ripe(self) -> list[Fruit]:
        """Fruit to pick, those that hang furthest out towards the dock first: reaching past a neighbour tears it off."""
        fruits = [f for f in self._fruits.machine.inventory.fruits if f.colour == "red" and may_be_picked(f)]
        return sorted(fruits, key=lambda fruit: (-fruit.x_m, fruit.fruit_id))

    # What robots tell

    async def scan(self, scan: Scan, robot_id: str) -> Response:
        """Merge it; raises Refused when it names a task that is no longer the robot's."""
        machine, now_s = self._fruits.machine, self._clock.now()
        if machine.knows(scan.scan_id):
            await self._fruits.settle()
            return self.shelf.whole()
        market = self._place.market
        if scan.task_id and robot_id:
            market.check_scan(scan.task_id, robot_id)
        doubts, undecided = market.doubts, market.undecided(now_s)
        merged = await self._fruits.change(lambda fruits: fruits.merge(scan, now_s, doubts, undecided))
        answer = self.shelf.whole()
        await self._settled(merged.settled, now_s)
        if scan.task_id and robot_id:
            await self._place.change(lambda m, at_s: m.scanned(scan.task_id, robot_id, scan.scan_id, at_s))
        await self._show(now_s)
        self.lost.update(left.lost for left in merged.left if left.lost)
        gone = "".join(f"; {left.fruit_id} left: {left.why}" for left in merged.left)
        told = f"{len(scan.sightings)} fruit seen, {len(merged.new)} of them new{gone}"
        self._journal.note("scan", told[:500], task_id=scan.task_id, robot_id=robot_id)
        return answer

    async def permit(self, task_id: str, request: PermitRequest, key: str) -> Permit:
        """A one-shot permit; a pick's line is in the ledger when it leaves."""
        permit = await self._place.change(lambda m, now_s: m.permit(task_id, request, key, now_s))
        if permit.act == "pick" and self.ledger.line(permit.permit_id) is None:
            task, fruit = self._place.market.task(task_id), self._fruits.machine.fruit(permit.fruit_id)
            if (line := ledger.begun(task, permit, fruit, self._clock.now())) is not None:
                await self.ledger.write(line)
        return permit

    async def report(self, task_id: str, told: Report) -> ReportAnswer:
        """A robot's progress. Picks reach the inventory and the ledger before the market forgets their permits."""
        market = self._place.market
        if told.picks and (verdicts := market.verdicts(task_id, told)):
            await self._picked(market.task(task_id), verdicts, told.robot_id)
        answer = await self._place.change(lambda m, now_s: m.report(task_id, told, now_s))
        if told.picks:
            await self._show(self._clock.now())
        return answer

    # What people ask for

    async def ask(self, request: TaskRequest, by: str, asking: Keyed | None = None) -> Task:
        """A scan, or ripe fruit; raises Conflict or Refused."""
        if request.kind == "inventory":
            return await self._place.change(
                lambda m, now_s: m.ask(
                    "inventory", 0.0, by, "asked by hand", now_s, request.priority,
                    within_s=request.within_s, asking=asking,
                )
            )  # fmt: skip
        await self._make_way(by)
        promised = {name for t in self._place.market.open_tasks() if t.kind == "harvest" for name in t.fruit_ids}
        names = request.fruit_ids or [fruit.fruit_id for fruit in self.ripe() if fruit.fruit_id not in promised]
        if not names:
            why = "all ripe fruit are being picked already" if promised else "no ripe fruit is known here"
            raise Refused(why, hint="GET /forecast tells when there will be more; or ask for a scan")
        count = min(request.count or len(names), len(names))
        why = f"order {request.order_id}" if request.order_id else "asked by hand"
        return await self._place.change(
            lambda m, now_s: m.ask(
                "harvest", 0.0, by, f"{count} ripe fruit: {why}", now_s, request.priority,
                within_s=request.within_s, fruit_ids=names, count=count, order_id=request.order_id,
                asking=asking,
            )
        )  # fmt: skip

    async def _make_way(self, by: str) -> None:
        """The plant's own wish stands back behind a person's, unless a robot is at it."""
        own = self._place.market.open_of("harvest")
        if own is not None and own.asked_by == OWN and own.state in ("announced", "awarded") and not own.permits:
            await self._place.change(lambda m, now_s: m.cancel(own.task_id, OWN, f"{by} wants fruit", now_s))

    # What the pot asks for itself

    async def think(self, settings: Settings) -> None:
        """Called now and then: tidy up, and ask for what is lacking."""
        now_s, market = self._clock.now(), self._place.market
        await self._show(now_s)
        if market.open_of("inventory") is None and (why := self._why_look(settings, now_s)):
            await self._ask_own("inventory", why, [], 0)
        elif settings.harvest and not market.doubts and not market.open_of("harvest") and (fruits := self._to_pick(now_s)):
            await self._ask_own("harvest", f"{len(fruits)} ripe fruit", [fruit.fruit_id for fruit in fruits], len(fruits))

    async def _ask_own(self, kind: str, why: str, fruit_ids: Sequence[str], count: int) -> None:
        if self._clock.now() < self._place.market.gave_up_s(kind) + AFTER_FAILURE_S:
            return
        try:
            await self._place.change(
                lambda m, now_s: m.ask(
                    "inventory" if kind == "inventory" else "harvest", 0.0, OWN, why, now_s,
                    fruit_ids=fruit_ids, count=count,
                )
            )  # fmt: skip
        except (Conflict, Refused) as error:
            self._journal.note("refused", str(error))

    def _why_look(self, settings: Settings, now_s: float) -> str:
        """Why a scan is wanted; empty when none is."""
        if doubts := self._place.market.doubts:
            return f"nobody told how the pick of {', '.join(doubts)} ended"
        if not settings.inventory:
            return ""
        fruits = self._fruits.machine
        scanned_s, hopes = fruits.inventory.scanned_s, fruits.outlook()[1]
        if scanned_s is None:
            return "this plant was never scanned"
        if (age_s := now_s - scanned_s) >= settings.inventory_every_s:
            return f"the last scan is {age_s / 3600.0:.1f} hours old"
        if (unsure := uncertainty(hopes, scanned_s, now_s)) > settings.uncertainty_max:
            return f"what is known has become uncertain: {unsure:.2f}"
        if age_s < LOOK_AGAIN_S:
            return ""
        ripening = [h.fruit for h in hopes if h.fruit.colour != "red" and h.belief.red(now_s) >= 0.5]
        failed = [h.fruit for h in hopes if h.fruit.failed and now_s >= fruits.look_again_s(h.fruit.fruit_id)]
        if found := [fruit.fruit_id for fruit in [*ripening, *failed]]:
            return f"{', '.join(found)} should be looked at: {'ripe by now' if ripening else 'the last pick failed'}"[:300]
        return ""

    def _to_pick(self, now_s: float) -> list[Fruit]:
        """Ripe fruit but for the few that are kept a while for people."""
        since, ripe = self._fruits.machine.ripe_since_s, self.ripe()
        old = [f for f in ripe if now_s - (since(f.fruit_id) or f.first_seen_s) >= KEEP_RIPE_S]
        young = [f for f in ripe if f not in old]
        return [*old, *young[: max(0, len(ripe) - max(KEEP_RIPE, len(old)))]] if len(ripe) > len(old) else old

    # In between

    async def _picked(self, task: Task, verdicts: Sequence[Pick], robot_id: str) -> None:
        now_s = self._clock.now()
        met = await self._fruits.change(lambda fruits: fruits.picked(verdicts, now_s))
        by_id = {fruit.fruit_id: fruit for fruit in met}
        lines = []
        for pick in verdicts:
            before = self.ledger.line(pick.permit_id) if pick.permit_id else None
            if (fruit := by_id.get(pick.fruit_id)) is not None or before is not None:
                lines.append(ledger.ended(task, pick, robot_id, fruit, before, now_s))
        await self.ledger.write(*lines)

    async def _settled(self, decided: dict[str, bool], now_s: float) -> None:
        """A scan has looked at fruit in doubt."""
        if not decided:
            return
        for line in self.ledger.lines():
            if line.fruit_id in decided and line.outcome in ("permitted", "in_doubt"):
                await self.ledger.change(
                    line.line_id, ended_s=now_s, outcome="hanging" if decided[line.fruit_id] else "gone"
                )
        await self._place.change(lambda m, at_s: m.settle(decided, at_s))

    async def _show(self, now_s: float) -> None:
        """The inventory tells which fruit are in doubt, and the market knows the fruit."""
        doubts = self._place.market.doubts
        await self._fruits.change(lambda fruits: fruits.refresh(doubts, now_s))
        for line in self._open_lines():
            if line.fruit_id in doubts and line.outcome == "permitted":
                await self.ledger.change(line.line_id, outcome="in_doubt", reason="nobody told how it ended")
        known = self._fruits.machine.inventory.fruits
        await self._place.change(lambda m, at_s: m.fruits(known, at_s))

    def _open_lines(self) -> list[LedgerLine]:
        return [line for line in self.ledger.lines() if line.outcome == "permitted"]
