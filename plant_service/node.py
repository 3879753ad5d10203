"""Builds a pot or a station: everything it needs is handed in."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from random import Random
from typing import TYPE_CHECKING

from core.allocation.docks import Docks, DocksDocument
from core.allocation.plant_side import Market
from core.allocation.plant_state import Limits, MarketDocument
from core.clock import Clock
from core.mesh.auth import Identity, Verifier
from core.mesh.chassis import create_app
from core.mesh.client import Mesh, PeerTransport
from core.mesh.metrics import measure
from core.mesh.node import Node
from core.mesh.peers import Peers
from core.mesh.presence import add_presence
from core.store import Disk, DurableDocument
from core.wire.plant import SettingsPatch
from hw.drivers.probes import open_probe, open_valve
from hw.links import Opener
from hw.ports import SoilProbe, Valve
from plant_service import api
from plant_service.inventory import Fruits, InventoryDocument
from plant_service.journal import Journal
from plant_service.keeper import Keeper
from plant_service.ledger import Ledger, LedgerDocument, Lines
from plant_service.market import Marketplace
from plant_service.metrics import of_pot, of_station
from plant_service.pot import Care, Pot
from plant_service.settings import PlantSettings
from plant_service.shelf import Shelf
from plant_service.station import Meter, Station, TapDocument
from plant_service.tending import Tending
from plant_service.texts import FruitTexts

if TYPE_CHECKING:
    import httpx

GATHER_S = 0.002
"""Those who write many fruits at once share their commits."""
Loop = Callable[[], Awaitable[None]]
OpenProbe = Callable[[str, Opener, Clock], SoilProbe]
OpenValve = Callable[[str, Opener, Clock], Valve]


def build(
    settings: PlantSettings,
    clock: Clock,
    opener: Opener,
    transport: PeerTransport | httpx.AsyncBaseTransport,
    rng: Random,
    *,
    identity: Identity | None = None,
    verifier: Verifier | None = None,
    peers: Peers | None = None,
    open_reads: bool = True,
    disk: Disk | None = None,
    probes: OpenProbe = open_probe,
    valves: OpenValve = open_valve,
) -> Node:
    """The node `settings` describe. Call inside the loop; raises StorageError, ConfigError.

    The data folder belongs to the node from here on, until its loops are cancelled. `verifier` None switches
    authentication off (tests). Nothing here is left to chance: `rng` is there for the shape all services share.
    `probes` and `valves` open the devices their URLs name.
    """
    journal = Journal(settings.id, settings.folder / "history.sqlite3", clock)
    maker = build_pot if settings.kind == "pot" else build_station
    mesh = Mesh(transport, identity, clock)
    peers = peers if peers is not None else Peers()
    parts = _Parts(settings, clock, opener, mesh, verifier, peers, journal, open_reads, disk)
    parts.probes, parts.valves = probes, valves
    node = maker(parts)
    add_presence(node.app, peers, clock, identity, node.kind, settings.url)
    return node


class _Parts:
    """What both kinds are made from."""

    def __init__(
        self,
        settings: PlantSettings,
        clock: Clock,
        opener: Opener,
        mesh: Mesh,
        verifier: Verifier | None,
        peers: Peers,
        journal: Journal,
        open_reads: bool,
        disk: Disk | None,
    ) -> None:
        self.settings, self.clock, self.opener, self.mesh = settings, clock, opener, mesh
        self.verifier, self.peers, self.journal, self.open_reads, self.disk = verifier, peers, journal, open_reads, disk
        self.probes: OpenProbe = open_probe
        self.valves: OpenValve = open_valve

    def file(self, name: str, gather_s: float = 0.0) -> DurableDocument:
        return DurableDocument(self.settings.folder / f"{name}.json", f"{name}/1", self.clock, self.disk, gather_s)

    def docks(self, dock_ids: list[str]) -> Keeper[Docks, DocksDocument]:
        owner, clock = self.settings.id, self.clock
        return Keeper(self.file("docks"), DocksDocument, lambda doc: Docks(owner, dock_ids, doc, clock.now()))


def build_pot(parts: _Parts) -> Node:
    settings, clock, journal = parts.settings, parts.clock, parts.journal
    limits = Limits()
    card, base = settings.card(), settings.care()
    texts = FruitTexts()
    stored = parts.file("inventory", GATHER_S)
    fruits = Keeper(stored, InventoryDocument, lambda doc: Fruits(settings.id, doc), texts.stored)

    def revived(doc: MarketDocument | None) -> Market:
        market = Market(card, doc, clock.now(), limits=limits)
        market.fruits(fruits.machine.inventory.fruits, clock.now())
        return market

    market = Keeper(parts.file("market"), MarketDocument, revived, found=lambda doc: doc.by_clock(clock.now()))
    lines = Keeper(parts.file("ledger"), LedgerDocument, Lines)
    care = Keeper(parts.file("settings"), SettingsPatch, lambda doc: Care(base, doc))
    docks = parts.docks([settings.id])
    probe = parts.probes(settings.probe_url, parts.opener, clock)
    place = Marketplace(market, parts.mesh, parts.peers, clock, journal)
    book = Ledger(lines, settings.folder / "pictures", clock, parts.disk)
    tending = Tending(fruits, Shelf(fruits, clock, texts), book, place, clock, journal)
    pot = Pot(settings, clock, probe, place, docks, tending, care, journal)
    keepers = (market, fruits, lines, care, docks)
    _tell_alarms(keepers, journal)
    app = create_app(
        card=pot.card, clock=clock, verifier=parts.verifier, ready=pot.ready, events=journal.events,
        open_reads=parts.open_reads,
    )  # fmt: skip
    api.add_pot(app, pot)
    measure(app.state.registry, lambda: of_pot(pot, parts.mesh, keepers, clock.now()))
    app.state.pot = pot
    loops = (probe.run, pot.watch, _closing(place.run, keepers), journal.run)
    return Node(settings.id, "plant", app, loops, settings.url)


def build_station(parts: _Parts) -> Node:
    settings, clock, journal = parts.settings, parts.clock, parts.journal
    valve = parts.valves(settings.tap_url, parts.opener, clock) if settings.tap_url else None
    docks = parts.docks([dock.id for dock in settings.docks])
    meter = Keeper(parts.file("tap"), TapDocument, Meter)
    station = Station(settings, clock, valve, docks, meter, journal)
    keepers = (docks, meter)
    _tell_alarms(keepers, journal)
    app = create_app(
        card=station.card, clock=clock, verifier=parts.verifier, ready=station.ready, events=journal.events,
        open_reads=parts.open_reads,
    )  # fmt: skip
    api.add_station(app, station)
    measure(app.state.registry, lambda: of_station(station, parts.mesh, keepers))
    loops: list[Loop] = [_closing(journal.run, keepers)]
    if valve is not None:
        loops.append(valve.run)
    return Node(settings.id, "station", app, tuple(loops), settings.url)


def _tell_alarms(keepers: tuple[Keeper, ...], journal: Journal) -> None:  # type: ignore[type-arg]
    for keeper in keepers:
        for alarm in keeper.alarms:
            journal.alarm(alarm)


def _closing(loop: Loop, keepers: tuple[Keeper, ...]) -> Loop:  # type: ignore[type-arg]
    """The loop, after which the documents are free for another writer."""

    async def run() -> None:
        try:
            await loop()
        finally:
            for keeper in keepers:
                keeper.close()

    return run
