"""A station: docks to rest at, one of them with a tap. It owns no task; robots come for themselves."""

from __future__ import annotations

from core.allocation.docks import Docks, DocksDocument
from core.clock import Clock
from core.errors import Conflict, Refused
from core.wire.documents import Document, Millilitres, NodeCard
from core.wire.market import Reservation, ReservationRequest
from core.wire.plant import DockState, StationState, TapGrant, TapRequest
from hw.ports import Valve
from plant_service.journal import Journal
from plant_service.keeper import Keeper
from plant_service.settings import PlantSettings


class TapDocument(Document):
    dispensed_ml: Millilitres = 0.0


class Meter:
    """What the tap has given so far; a machine for `Keeper`."""

    def __init__(self, document: TapDocument | None) -> None:
        self.dispensed_ml = document.dispensed_ml if document else 0.0
        self.dirty = False

    def document(self) -> TapDocument:
        return TapDocument(dispensed_ml=self.dispensed_ml)

    def debit(self, ml: float) -> None:
        self.dispensed_ml += ml
        self.dirty = True


class Station:
    """Docks and a tap."""

    def __init__(
        self,
        settings: PlantSettings,
        clock: Clock,
        valve: Valve | None,
        docks: Keeper[Docks, DocksDocument],
        meter: Keeper[Meter, TapDocument],
        journal: Journal,
    ) -> None:
        self.settings, self.docks, self.meter, self.journal = settings, docks, meter, journal
        self._clock, self._valve = clock, valve
        self._open_until_s = 0.0

    def card(self) -> NodeCard:
        docks = [{"id": dock.id, "pose": dock.pose.model_dump(), "tap": dock.tap} for dock in self.settings.docks]
        place = {"place": self.settings.place.model_dump(), "docks": docks}
        capabilities = ["dock", *(["tap"] if self._valve is not None else [])]
        links = {name: f"/{name}" for name in ("state", "dock", "history", "events", "docs")}
        return NodeCard(id=self.settings.id, kind="station", capabilities=capabilities, place=place, links=links)

    def ready(self) -> list[str]:
        """What is missing; empty: ready."""
        stores = {"docks": self.docks.broken, "tap's meter": self.meter.broken}
        missing = [f"the {name} cannot be stored: {why}" for name, why in stores.items() if why]
        if self._valve is not None and not self._valve.link.up:
            missing.append(f"the tap: {self._valve.link.why}")
        return missing

    def state(self) -> StationState:
        now_s = self._clock.now()
        return StationState(
            station_id=self.settings.id, now_s=now_s, docks=self.dock_states(), tap_open=now_s < self._open_until_s,
            dispensed_ml=self.meter.machine.dispensed_ml,
        )  # fmt: skip

    def dock_states(self) -> list[DockState]:
        now_s, docks = self._clock.now(), self.docks.machine
        states = []
        for dock in self.settings.docks:
            loan = docks.loan(dock.id, now_s)
            states.append(
                DockState(
                    dock_id=dock.id,
                    pose=dock.pose,
                    tap=dock.tap,
                    holder=loan.robot_id,
                    yielding=loan.yielding,
                    wanted_by=docks.wanted_by(dock.id, now_s),
                )
            )
        return states

    async def reserve(self, request: ReservationRequest) -> Reservation:
        return await self.docks.change(lambda docks: docks.reserve(request, self._clock.now()))

    async def release(self, reservation_id: str, robot_id: str) -> None:
        """Give a dock back; a tap that still runs is shut."""
        dock_id = await self.docks.change(lambda docks: docks.release(reservation_id, robot_id))
        if self._valve is not None and any(dock.tap for dock in self.settings.docks if dock.id == dock_id):
            await self._valve.shut()
            self._open_until_s = 0.0

    async def tap(self, request: TapRequest) -> TapGrant:
        """Open the tap for the robot that holds its dock; what may flow is debited durably before."""
        self._check_tap(request.robot_id)
        assert self._valve is not None
        flow_mlps, now_s = self.settings.tap_flow_mlps, self._clock.now()
        # Claimed at once, so that a second request during the commit is refused.
        self._open_until_s = now_s + request.open_s
        try:
            await self.meter.change(lambda meter: meter.debit(request.open_s * flow_mlps))
            await self._valve.open_for(request.open_s)
        except BaseException:
            self._open_until_s = 0.0
            raise
        self.journal.note("tap", f"open for {request.open_s:.1f} s", robot_id=request.robot_id)
        return TapGrant(open_s=request.open_s, flow_mlps=flow_mlps)

    def _check_tap(self, robot_id: str) -> None:
        taps = [dock.id for dock in self.settings.docks if dock.tap]
        if not taps or self._valve is None:
            raise Refused(f"{self.settings.id} has no tap", hint="ask another station")
        now_s = self._clock.now()
        holders = [self.docks.machine.loan(dock_id, now_s).robot_id for dock_id in taps]
        if robot_id not in holders:
            who = holders[0] or "nobody"
            raise Refused(f"the dock at the tap is held by {who}", hint=f"reserve dock {taps[0]}, dock there, ask again")
        if now_s < self._open_until_s:
            raise Conflict(f"the tap is open for another {self._open_until_s - now_s:.1f} s", hint="wait for it to shut")
