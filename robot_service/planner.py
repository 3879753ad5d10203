"""Takes one task apart into jobs (undock, navigate, dock, act) and oversees them. Paper 000, section 2.1."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass

from core.allocation.bidding import BATTERY_ENOUGH_RATIO, Travel
from core.allocation.queue import Entry
from core.errors import GardenError, NotFound, PeerDown
from core.mesh.client import retry
from core.wire.fruit import Fruit, Inventory, Pick, Scan
from core.wire.market import Announcement, Permit, PermitRequest, PlantCard, Report
from core.wire.robot import JobRequest
from robot_service.docks import Docks
from robot_service.eye import JPEG_COST_S, Look, drawn_jpeg
from robot_service.robot import RANK_IDLE, Robot, SkillFailed, reason_of, tuple_of
from robot_service.skills.dock import dock_at
from robot_service.skills.drive import drive_to, undock
from robot_service.skills.hand import empty_hand
from robot_service.skills.pick import KeepPicture, harvest
from robot_service.skills.scan import scan
from robot_service.skills.supply import charge, refill
from robot_service.skills.water import Poured, water

TASK_S = {"water": 900.0, "inventory": 600.0, "harvest": 1800.0, "charge": 5 * 3600.0, "refill": 900.0, "job": 900.0}
"""Longest time for a whole task; a longer one is given back."""


@dataclass(frozen=True, slots=True)
class Hand:
    """What eye and hand do at a dock: the skills that need a camera. Another hand may be given to a brain."""

    scan: Callable[[Robot, PlantCard, str, str], Awaitable[Scan]] = scan
    harvest: Callable[..., Awaitable[None]] = harvest
    empty: Callable[[Robot], Awaitable[None]] = empty_hand


@dataclass(slots=True)
class Planner:
    robot: Robot
    docks: Docks
    travel: Travel
    hand: Hand = Hand()

    async def run(self, entry: Entry) -> Report:
        """Do one entry; the report says how it ended. Never raises SkillFailed."""
        poured = Poured()
        try:
            async with self.robot.clock.timeout(TASK_S.get(entry.kind, 900.0)):
                await self._perform(entry, poured)
        except TimeoutError:
            return self._ended(entry, "failed", f"took longer than {TASK_S.get(entry.kind, 900.0):.0f} s", poured)
        except GardenError as error:
            return self._ended(entry, "failed", poured.why or reason_of(error), poured)
        return self._ended(entry, "failed" if poured.why else "done", poured.why, poured)

    def _ended(self, entry: Entry, state: str, reason: str, poured: Poured) -> Report:
        delivered_ml = poured.delivered_ml if entry.kind == "water" else None
        return Report(
            robot_id=self.robot.settings.id,
            epoch=entry.epoch,
            state="done" if state == "done" else "failed",
            phase=entry.phase,
            progress=1.0 if state == "done" else entry.progress,
            reason=reason,
            delivered_ml=delivered_ml,
            picks=list(entry.picks),
        )

    async def _perform(self, entry: Entry, poured: Poured) -> None:
        self.robot.activity.waiting = ""
        if entry.kind == "water" and entry.announcement is not None:
            await self._water(entry, entry.announcement, poured)
        elif entry.kind == "inventory" and entry.announcement is not None:
            await self._inventory(entry, entry.announcement)
        elif entry.kind == "harvest" and entry.announcement is not None:
            await self._harvest(entry, entry.announcement)
        elif entry.kind == "charge":
            await charge(
                self.robot, self.docks, self.travel, lambda ratio: entry.killed != "" and ratio > BATTERY_ENOUGH_RATIO
            )
        elif entry.kind == "refill":
            await refill(self.robot, self.docks, self.travel)
        elif entry.job is not None:
            await self._job(entry.job)
        else:
            raise SkillFailed(f"cannot {entry.kind}")

    async def _water(self, entry: Entry, asked: Announcement, poured: Poured) -> None:
        await dock_at(self.robot, self.docks, asked.plant.plant_id)
        self.robot.activity.job = "act"
        entry.progress = 0.6
        wish = PermitRequest(robot_id=self.robot.settings.id, epoch=entry.epoch, act="water", amount_ml=asked.dose_ml)
        known = await self._known(asked)
        await water(self.robot, asked.plant, lambda: self._permit(entry, asked, wish), poured, known)

    async def _inventory(self, entry: Entry, asked: Announcement) -> None:
        await dock_at(self.robot, self.docks, asked.plant.plant_id)
        self.robot.activity.job = "act"
        entry.progress = 0.4
        await self.hand.empty(self.robot)
        scan_id = f"{asked.task_id}:{self.robot.settings.id}:{entry.epoch}"
        seen = await self.hand.scan(self.robot, asked.plant, scan_id, asked.task_id)
        entry.progress = 0.9
        plant = self.robot.peers.get(asked.plant.plant_id)

        async def tell() -> Inventory:
            self.robot.state()
            return await self.robot.mesh.call(plant, "POST", "/inventory/scans", seen, expect=Inventory, key=scan_id)

        try:
            known = await retry(self.robot.clock, self.robot.rng, tell, tries=6, base_s=0.3, cap_s=4.0)
        except PeerDown:
            raise SkillFailed("the plant did not take the scan") from None
        self.robot.note("scan", f"{len(seen.sightings)} fruit seen, {len(known.fruits)} known", task_id=asked.task_id)

    async def _harvest(self, entry: Entry, asked: Announcement) -> None:
        await dock_at(self.robot, self.docks, asked.plant.plant_id)
        self.robot.activity.job = "act"
        entry.progress = 0.3
        await self.hand.empty(self.robot)
        wanted = asked.count or len(asked.fruits)

        async def leave(fruit_id: str) -> tuple[Permit, float]:
            wish = PermitRequest(robot_id=self.robot.settings.id, epoch=entry.epoch, act="pick", fruit_id=fruit_id)
            return await self._permit(entry, asked, wish)

        def ended(pick: Pick) -> None:
            entry.picks.append(pick)
            picked = sum(one.outcome == "picked" for one in entry.picks)
            entry.progress = 0.3 + 0.6 * picked / max(1, wanted)
            self.robot.note("pick", f"{pick.fruit_id} {pick.outcome}: {pick.reason}".rstrip(": "), task_id=asked.task_id)
            # Between two fruit the task may be taken away; what is held is carried to the basket first.
            entry.committed = False
            if entry.killed:
                raise SkillFailed(entry.killed)

        before = len(entry.picks)
        known = await self._known(asked)
        keep = self._keep_picture(asked)
        await self.hand.harvest(self.robot, asked.plant, asked.fruits, wanted, leave, keep, ended, known)
        picks = entry.picks[before:]
        if not any(pick.outcome == "picked" for pick in picks):
            raise SkillFailed("; ".join(f"{pick.fruit_id}: {pick.reason}" for pick in picks)[:400] or "nothing to pick")

    async def _known(self, asked: Announcement) -> list[Fruit]:
        """All fruit of the plant: the hand keeps away from those that are not to be picked. Without an answer, what was
        announced; a plant need not keep an inventory."""
        plant = self.robot.peers.get(asked.plant.plant_id)
        try:
            return (await self.robot.mesh.call(plant, "GET", "/inventory", expect=Inventory)).fruits
        except NotFound:
            return asked.fruits
        except GardenError as error:
            self.robot.note(asked.kind, f"fruit in the way are unknown, no inventory: {error}", task_id=asked.task_id)
            return asked.fruits

    def _keep_picture(self, asked: Announcement) -> KeepPicture:
        """Sends pictures to the plant's ledger. Evidence, not the deed: a plant that does not take one changes nothing."""

        async def keep(permit: Permit, when: str, look: Look) -> None:
            plant = self.robot.peers.get(asked.plant.plant_id)
            try:
                picture = await self.robot.clock.offload(lambda: drawn_jpeg(look), JPEG_COST_S)
                answer = await self.robot.mesh.exchange(
                    plant,
                    "PUT",
                    f"/ledger/{permit.permit_id}/{when}.jpg",
                    picture,
                    headers={"content-type": "image/jpeg"},
                )
                if answer.status >= 400:
                    self.robot.note("picture", f"{when} was not taken: HTTP {answer.status}", task_id=asked.task_id)
            except GardenError as error:
                self.robot.note("picture", f"{when} was not taken: {error}", task_id=asked.task_id)

        return keep

    async def _permit(self, entry: Entry, asked: Announcement, wish: PermitRequest) -> tuple[Permit, float]:
        """Ask the plant for leave to act. A lost answer is asked for again under the same key, and is the same permit."""
        plant = self.robot.peers.get(asked.plant.plant_id)
        asked_s = self.robot.clock.now()
        key = f"permit-{asked.task_id}-{entry.epoch}" + (f"-{wish.fruit_id}" if wish.fruit_id else "")

        async def ask() -> Permit:
            self.robot.state()
            return await self.robot.mesh.call(
                plant,
                "POST",
                f"/tasks/{asked.task_id}/permits",
                wish,
                expect=Permit,
                key=key,
            )

        entry.committed = True
        try:
            permit = await retry(self.robot.clock, self.robot.rng, ask, tries=4, base_s=0.3, cap_s=2.0)
        except PeerDown:
            raise SkillFailed("the plant did not answer whether we may act") from None
        if wish.act == "water":
            entry.progress = 0.75
        return permit, asked_s

    async def _job(self, job: JobRequest) -> None:
        robot = self.robot
        if job.kind == "dock":
            await dock_at(robot, self.docks, job.at)
            return
        if robot.where.docked_at or job.kind == "undock":
            await undock(robot, self.docks)
        if job.kind == "home":
            await drive_to(robot, tuple_of(robot.settings.home), rank=RANK_IDLE)
        elif job.kind == "goto":
            pose = robot.pose()
            yaw = job.yaw_rad if job.yaw_rad is not None else pose[2]
            goal = (job.x_m if job.x_m is not None else pose[0], job.y_m if job.y_m is not None else pose[1], yaw)
            await drive_to(robot, goal, yaw_matters=job.yaw_rad is not None)
