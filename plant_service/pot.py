"""A pot: it reads its soil, knows when it is thirsty, and asks for water."""

from __future__ import annotations

from statistics import median
from urllib.parse import parse_qs, urlsplit

from core import soil
from core.allocation import permits
from core.allocation.docks import Docks, DocksDocument
from core.allocation.plant_state import Keyed
from core.clock import Clock
from core.errors import DriverError, Refused, StorageError, Unavailable, Unprocessable
from core.soil import Limits, ProbeState, Reading
from core.wire.documents import NodeCard
from core.wire.market import Reservation, ReservationRequest, Task, TaskRequest
from core.wire.plant import DockState, PlantState, Settings, SettingsPatch, SoilReading
from hw.ports import SoilProbe
from hw.protocols.vh400 import Calibration
from plant_service.journal import Journal
from plant_service.keeper import Keeper
from plant_service.market import Marketplace
from plant_service.settings import PlantSettings
from plant_service.tending import Tending

SAMPLES = 5
SAMPLE_WITHIN_S = 5.0
SOAK_PROBE_S = 2.0
"""How often to look while a dose soaks in."""
KEEP_READING_S = 60.0
"""The history gets one soil reading this often, and every change of state."""
THIRST_AGAIN_S = 1800.0
"""After a watering failed, wait this long before asking anew."""
_WHY = {
    ProbeState.GOOD: "",
    ProbeState.STALE: "stale: no new sample for a minute",
    ProbeState.STUCK: "stuck: its reading does not move at all",
    ProbeState.OUT_OF_RANGE: "out of range: more than the probe can give",
    ProbeState.OPEN: "open: is it plugged in and in the soil?",
    ProbeState.SHORT: "shorted to the supply",
    ProbeState.DOWN: "down: it never answered",
}


class Care:
    """The settings an operator may change; a machine for `Keeper`."""

    def __init__(self, base: Settings, patch: SettingsPatch | None) -> None:
        self._base, self._patch = base, patch or SettingsPatch()
        self.dirty = False

    @property
    def settings(self) -> Settings:
        return self._base.model_copy(update=self._patch.model_dump(exclude_none=True))

    def document(self) -> SettingsPatch:
        return self._patch

    def change(self, patch: SettingsPatch) -> Settings:
        """Raises Unprocessable when the parts do not fit together."""
        merged = self._patch.model_copy(update=patch.model_dump(exclude_none=True))
        after = self._base.model_copy(update=merged.model_dump(exclude_none=True))
        if after.target_ratio <= after.threshold_ratio:
            raise Unprocessable(
                f"target_ratio {after.target_ratio} must lie above threshold_ratio {after.threshold_ratio}",
                hint="send both",
            )
        self._patch, self.dirty = merged, True
        return after


class Pot:
    """Ties probe, market, docks and inventory of one plant together."""

    def __init__(
        self,
        settings: PlantSettings,
        clock: Clock,
        probe: SoilProbe,
        place: Marketplace,
        docks: Keeper[Docks, DocksDocument],
        tending: Tending,
        care: Keeper[Care, SettingsPatch],
        journal: Journal,
    ) -> None:
        self.settings, self.place, self.docks, self.tending, self.care = settings, place, docks, tending, care
        self.journal = journal
        self._clock, self._probe = clock, probe
        self._limits = soil_limits(settings)
        self._readings: tuple[Reading, ...] = ()
        self._state: ProbeState | None = None
        self._ratio: float | None = None
        self._thirsty = any(task.asked_by == "soil" for task in place.market.open_tasks())
        self._kept_s = -KEEP_READING_S
        self._told = ""

    # What others read

    def card(self) -> NodeCard:
        card = self.settings.card()
        place = {"stem": card.stem.model_dump(), "dock": card.dock.model_dump(), "nozzle": card.nozzle.model_dump()}
        return NodeCard(
            id=self.settings.id, kind="plant", capabilities=["water", "inventory", "harvest"], place=place, links=_links()
        )

    def ready(self) -> list[str]:
        """What is missing before the pot does its work; empty: ready."""
        stores = {"market": self.place.broken, "docks": self.docks.broken, "inventory": self.tending.shelf.broken}
        missing = [f"{name} cannot be stored: {why}" for name, why in stores.items() if why]
        return missing if self._state is not None else [*missing, "the soil has not been measured yet"]

    def state(self) -> PlantState:
        now_s, market = self._clock.now(), self.place.market
        return PlantState(
            plant_id=self.settings.id, now_s=now_s, soil=self.soil(), thirsty=self._thirsty,
            settings=self.care.machine.settings, open_tasks=[task.task_id for task in market.open_tasks()],
            watered_today_ml=market.given_ml(now_s), dock_holder=self.docks.machine.loan("", now_s).robot_id,
            fruit=self.tending.counts(), fruit_uncertainty=self.tending.uncertainty(), waiting=self.waiting(),
            card=self.settings.card(),
        )  # fmt: skip

    def soil(self) -> SoilReading:
        """The newest judged reading."""
        if self._state is None:
            return SoilReading(state="unknown", why="not measured yet")
        last = self._readings[-1] if self._readings else None
        return SoilReading(
            state=self._state.value, ratio=self._ratio, why=self._why(self._state),
            volts=median(last.samples_v) if last else None,
            age_s=max(0.0, self._clock.now() - last.stamp_s) if last else None,
        )  # fmt: skip

    def waiting(self) -> str:
        """Why nothing happens although something is wanted, or could be."""
        now_s, market = self._clock.now(), self.place.market
        if self._state not in (None, ProbeState.GOOD):
            assert self._state is not None
            return f"not watering: the soil probe is {self._why(self._state)}"[:500]
        if why := market.waiting(now_s):
            return why
        if not self._thirsty or market.open_of("water"):
            return ""
        if market.left_ml(now_s) < permits.DOSE_ML_MIN:
            return f"thirsty, but the day's {market.limits.day_cap_ml:.0f} ml are given"
        left_s = self._ask_again_s() - now_s
        return f"the last watering failed; asking again in {left_s:.0f} s" if left_s > 0 else ""

    def dock_states(self) -> list[DockState]:
        now_s, docks, pose = self._clock.now(), self.docks.machine, self.settings.dock
        assert pose is not None
        loan = docks.loan("", now_s)
        wanted_by = docks.wanted_by("", now_s)
        return [
            DockState(dock_id=loan.dock_id, pose=pose, holder=loan.robot_id, yielding=loan.yielding, wanted_by=wanted_by)
        ]

    # What others ask for

    async def ask(self, request: TaskRequest, by: str, key: str = "") -> Task:
        """An operator wants something here; the same request under the same `key` is the same task, restarts or not.

        Raises Conflict or Refused, and Unprocessable for a key that came with another request.
        """
        asking = Keyed.of(by, key, request.model_dump_json().encode()) if key else None
        if asking is not None and (task := await self.place.change(lambda m, _: m.asked_before(asking))) is not None:
            return task
        if request.kind != "water":
            return await self.tending.ask(request, by, asking)
        dose = request.dose_ml if request.dose_ml is not None else self.care.machine.settings.dose_ml
        return await self.place.change(
            lambda m, now_s: m.ask(
                "water", dose, by, "asked by hand", now_s, request.priority, within_s=request.within_s, asking=asking
            )
        )

    async def set_care(self, patch: SettingsPatch, by: str) -> Settings:
        settings = await self.care.change(lambda care: care.change(patch))
        self._apply(settings)
        changed = patch.model_dump(exclude_none=True)
        self.journal.note("settings", f"{by} set {', '.join(f'{k} = {v}' for k, v in changed.items())}")
        return settings

    async def reserve(self, request: ReservationRequest) -> Reservation:
        if request.dock_id == self.settings.id:
            request = request.model_copy(update={"dock_id": ""})
        return await self.docks.change(lambda docks: docks.reserve(request, self._clock.now()))

    async def release(self, reservation_id: str, robot_id: str) -> None:
        await self.docks.change(lambda docks: docks.release(reservation_id, robot_id))

    # The loop

    async def watch(self) -> None:
        """Probe, judge, tell the market, ask for water; for ever."""
        self._apply(self.care.machine.settings)
        while True:
            began_s = self._clock.now()
            await self.measure()
            try:
                await self.think()
                await self.tending.think(self.care.machine.settings)
            except StorageError as error:
                self.journal.alarm(f"not asking for anything: {error}")
            every_s = self.care.machine.settings.probe_every_s
            if self.place.market.soaking:
                every_s = min(every_s, SOAK_PROBE_S)
            await self._clock.sleep(max(0.5, began_s + every_s - self._clock.now()))

    async def measure(self) -> None:
        """Take one reading and judge it."""
        asked_s = self._clock.now()
        samples_v = await self._sample()
        now_s = self._clock.now()
        state, ratio = soil.judge(samples_v, self._readings, now_s, self._limits)
        self._readings = soil.remember(self._readings, samples_v, asked_s, self._limits)
        if state is not self._state:
            self.journal.note("probe", f"soil probe {self._why(state) or 'good'}", state=state.value)
        if state is not self._state or now_s - self._kept_s >= KEEP_READING_S:
            self._kept_s = now_s
            told = f"water content {ratio:.3f}" if ratio is not None else f"no measurement: {state.value}"
            self.journal.note("soil", told, state=state.value, ratio=ratio)
        self._state, self._ratio = state, ratio

    async def think(self) -> None:
        """Tell the market what was measured, and ask for water or take the asking back."""
        ratio, state = self._ratio, self._state or ProbeState.DOWN
        # A reading that failed leaves the one before standing for a while, and this process may have slept since.
        stamp_s = self._readings[-1].stamp_s if self._readings else None
        await self.place.change(lambda m, now_s: m.soil(ratio, self._why(state), now_s, stamp_s))
        self._feel(ratio)
        if self._should_ask():
            await self._ask()
        elif not self._thirsty:
            await self._withdraw()
        if (why := self.waiting()) != self._told and not why.startswith("measuring again"):
            self._told = why
            if why:
                self.journal.note("waiting", why)

    async def _sample(self) -> tuple[float, ...]:
        try:
            async with self._clock.timeout(SAMPLE_WITHIN_S):
                return await self._probe.sample(SAMPLES)
        except (Unavailable, DriverError, TimeoutError):
            return ()

    def _why(self, state: ProbeState) -> str:
        why = _WHY[state]
        down = state in (ProbeState.DOWN, ProbeState.STALE) and not self._probe.link.up
        return f"{why} ({self._probe.link.why})"[:300] if down else why

    def _feel(self, ratio: float | None) -> None:
        """Thirst with hysteresis; without a measurement it stays as it is."""
        care = self.care.machine.settings
        if ratio is not None:
            self._thirsty = ratio < (care.target_ratio if self._thirsty else care.threshold_ratio)

    def _should_ask(self) -> bool:
        market, now_s = self.place.market, self._clock.now()
        able = self._state is ProbeState.GOOD and not market.permit_open and not market.open_of("water")
        enough = market.left_ml(now_s) >= permits.DOSE_ML_MIN
        return self._thirsty and able and enough and now_s >= self._ask_again_s()

    def _ask_again_s(self) -> float:
        return self.place.market.gave_up_s("water") + THIRST_AGAIN_S

    async def _ask(self) -> None:
        care = self.care.machine.settings
        why = f"water content {self._ratio:.3f} is below {care.threshold_ratio:.3f}"
        if self._ratio is not None and self._ratio >= care.threshold_ratio:
            why = f"water content {self._ratio:.3f} has not reached {care.target_ratio:.3f}"
        try:
            await self.place.change(lambda m, now_s: m.ask("water", care.dose_ml, "soil", why, now_s))
        except Refused as error:
            self.journal.note("refused", str(error))

    async def _withdraw(self) -> None:
        """Somebody else watered, or it rained: nobody need come."""
        for task in self.place.market.open_tasks():
            if task.asked_by == "soil" and not task.permit_id and not self.place.market.permit_open:
                await self.place.change(lambda m, now_s, i=task.task_id: m.cancel(i, "soil", "moist again", now_s))  # type: ignore[misc]

    def _apply(self, settings: Settings) -> None:
        self.place.configure(settings.soak_s, settings.day_cap_ml, settings.target_ratio)


def soil_limits(settings: PlantSettings) -> Limits:
    """What `core.soil` needs to judge this pot's probe."""
    query = parse_qs(urlsplit(settings.probe_url).query)
    curve = Calibration(settings.probe_gain, settings.probe_offset_ratio)
    return Limits(ratio_of=curve.ratio_of, vref_v=float(query.get("vref", ["5.0"])[0]))


def _links() -> dict[str, str]:
    return {
        name: f"/{name}"
        for name in ("state", "inventory", "forecast", "ledger", "tasks", "history", "dock", "events", "docs")
    }
