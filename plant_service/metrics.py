"""What a pot and a station tell at `/metrics`: whatever somebody may want to be woken for (docs/metrics.md)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from core.mesh.client import Mesh
from core.mesh.metrics import Reading, of_events, of_mesh
from core.soil import ProbeState
from core.wire.plant import DockState
from plant_service.keeper import Keeper
from plant_service.pot import Pot
from plant_service.station import Station

KINDS = ("water", "inventory", "harvest")
OPEN_STATES = ("announced", "awarded", "running")
COUNTED = {
    "awards": "Tasks awarded",
    "reawards": "Tasks moved to a cheaper robot before they began",
    "awards_refused": "Awards that a robot refused",
    "leases_lost": "Robots that fell silent with a task",
    "permits": "Permits given",
    "doses_lost": "Doses permitted whose water did not arrive",
    "rounds": "Rounds of bids",
    "kills": "Kill messages",
}


def of_pot(pot: Pot, mesh: Mesh, keepers: Sequence[Keeper[Any, Any]], now_s: float) -> Iterator[Reading]:
    yield from _tasks(pot, now_s)
    yield from _doses(pot, now_s)
    yield from _soil(pot)
    yield from _fruit(pot)
    yield from _docks(pot.dock_states())
    yield from stores(keepers)
    yield from of_mesh(mesh)
    yield from of_events(pot.journal.events)


def of_station(station: Station, mesh: Mesh, keepers: Sequence[Keeper[Any, Any]]) -> Iterator[Reading]:
    state = station.state()
    yield Reading("garden_tap_open", "1 while the tap is open", state.tap_open)
    yield Reading("garden_tap_dispensed_ml_total", "Debited at the tap", state.dispensed_ml)
    yield from _docks(state.docks)
    yield from stores(keepers)
    yield from of_mesh(mesh)
    yield from of_events(station.journal.events)


def _tasks(pot: Pot, now_s: float) -> Iterator[Reading]:
    open_tasks = pot.place.market.open_tasks()
    for kind in KINDS:
        for state in OPEN_STATES:
            ages_s = [now_s - task.created_s for task in open_tasks if (task.kind, task.state) == (kind, state)]
            labels = {"kind": kind, "state": state}
            yield Reading("garden_tasks_open", "Open tasks", len(ages_s), labels)
            yield Reading("garden_tasks_oldest_seconds", "Age of the oldest of them", max(ages_s, default=0.0), labels)
    counts = pot.place.tally.counts
    for state in ("done", "failed", "cancelled"):
        yield Reading("garden_tasks_ended_total", "Tasks that ended", counts[state], {"state": state})
    for name, told in COUNTED.items():
        yield Reading(f"garden_market_{name}_total", told, counts[name])
    yield Reading("garden_waiting", "1 while something is wanted and cannot happen: /state says why", bool(pot.waiting()))


def _doses(pot: Pot, now_s: float) -> Iterator[Reading]:
    market = pot.place.market
    yield Reading("garden_permit_open", "1 while a dose is permitted and not yet measured", market.permit_open)
    yield Reading("garden_fruit_in_doubt", "Fruit whose permitted pick nobody told the end of", len(market.doubts))
    yield Reading("garden_dosed_today_ml", "Debited in the past 24 hours", market.given_ml(now_s))
    yield Reading("garden_dose_cap_ml", "What may be debited in 24 hours", market.limits.day_cap_ml)


def _soil(pot: Pot) -> Iterator[Reading]:
    soil = pot.soil()
    for state in (*(state.value for state in ProbeState), "unknown"):
        yield Reading("garden_soil_state", "1 for the state the probe is in", soil.state == state, {"state": state})
    if soil.ratio is not None:
        yield Reading("garden_soil_ratio", "Water content; absent unless the probe is good", soil.ratio)
    if soil.age_s is not None:
        yield Reading("garden_soil_age_seconds", "Since the newest reading", soil.age_s)
    yield Reading("garden_soil_threshold_ratio", "Below it the pot is thirsty", pot.care.machine.settings.threshold_ratio)


def _fruit(pot: Pot) -> Iterator[Reading]:
    for colour, count in pot.tending.counts():
        yield Reading("garden_fruit", "Fruit of the inventory", count, {"colour": colour})
        told = "Fruit that a scan found gone and nobody told of: torn, fallen, or never there"
        yield Reading("garden_fruit_lost_total", told, pot.tending.lost[colour], {"colour": colour})
    yield Reading("garden_fruit_uncertainty_ratio", "0 just scanned, 1 nothing known", pot.tending.uncertainty())


def _docks(docks: Sequence[DockState]) -> Iterator[Reading]:
    for dock in docks:
        labels = {"dock": dock.dock_id}
        yield Reading("garden_dock_held", "1 while a robot holds the dock", dock.holder != "", labels)
        yield Reading("garden_dock_wanted", "1 while another waits for it", dock.wanted_by != "", labels)


def stores(keepers: Sequence[Keeper[Any, Any]]) -> Iterator[Reading]:
    """Of every durable document: commits, what they took, and whether anything is acknowledged still."""
    for keeper in keepers:
        labels = {"store": keeper.name}
        yield Reading("garden_store_commits_total", "Commits", keeper.commits, labels)
        yield Reading("garden_store_commit_seconds_total", "Spent on commits", keeper.commit_s, labels)
        yield Reading("garden_store_commit_last_seconds", "The last commit took", keeper.last_commit_s, labels)
        yield Reading("garden_store_failures_total", "Commits that failed", keeper.failures, labels)
        yield Reading("garden_store_broken", "1 once nothing is acknowledged any more", keeper.broken != "", labels)
        yield Reading("garden_store_damaged_total", "Damaged files put aside at start", len(keeper.alarms), labels)
