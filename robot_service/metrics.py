"""What a robot tells at `/metrics`: whatever somebody may want to be woken for. The list is in docs/metrics.md."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import TYPE_CHECKING

from core.mesh.metrics import Reading, of_events, of_mesh
from core.wire.body import BodyState

if TYPE_CHECKING:
    from robot_service.brain import Brain

LATE_KEPT = 3000
"""A minute's worth at the body's full rate."""


class RobotReadings:
    """Reads a brain at every scrape, and between them how late its body's words come."""

    def __init__(self, brain: Brain) -> None:
        self._brain = brain
        self._late_s: deque[float] = deque(maxlen=LATE_KEPT)
        self._due_s: float | None = None
        self._refusals, self._refusal = 0, ""
        brain.body.listeners.append(self._heard)

    def _heard(self, state: BodyState) -> None:
        if self._due_s is not None:
            self._late_s.append(max(0.0, state.stamp_s - self._due_s))
        self._due_s = state.stamp_s + state.next_in_s
        self._refusals += state.refusal not in ("", self._refusal)
        self._refusal = state.refusal

    def read(self) -> Iterator[Reading]:
        yield from self._work()
        yield from self._body()
        yield from self._place()
        yield from of_mesh(self._brain.robot.mesh)
        yield from of_events(self._brain.events)

    def _work(self) -> Iterator[Reading]:
        brain = self._brain
        entries = brain.queue.entries
        yield Reading("garden_queue_length", "Tasks and errands promised", len(entries))
        yield Reading("garden_queue_running", "1 while one of them is under way", any(entry.running for entry in entries))
        yield Reading(
            "garden_waiting", "1 while it waits for something: /state says for what", bool(brain.robot.activity.waiting)
        )
        yield Reading("garden_reports_unheard", "Ends that no plant has heard yet", brain.reporter.unheard)
        yield Reading("garden_parts_failed", "Pumps and taps it does not count on for now", len(brain.robot.fitness.told()))
        yield Reading("garden_refusals_total", "Times the body's gate refused what was asked", self._refusals)
        yield Reading("garden_docks_held", "Docks reserved", len(brain.docks.holds))

    def _body(self) -> Iterator[Reading]:
        body = self._brain.body
        state = body.state
        yield Reading("garden_body_down", "1 while the body cannot be used", bool(body.down))
        late_s = max(self._late_s, default=0.0)
        yield Reading("garden_body_late_seconds", "Latest of the body's last 3000 words, beyond what it promised", late_s)
        if state is None:
            return
        yield Reading("garden_estop_latched", "1 while stopped", state.stopped)
        yield Reading("garden_devices_down", "Devices whose link is down", len(state.down))
        yield Reading("garden_battery_ratio", "Charge", state.battery_ratio)
        yield Reading("garden_charging", "1 while charge current flows", state.docked)
        if state.tank_ml is not None:
            yield Reading("garden_tank_ml", "Water; absent while its sensor is silent", state.tank_ml)

    def _place(self) -> Iterator[Reading]:
        where = self._brain.robot.where
        yield Reading("garden_position_known", "1 while it knows where it is", where.pose is not None)
        if where.pose is not None:
            yield Reading("garden_position_sigma_m", "Standard deviation of its place", where.sigma_m)
        if (state := self._brain.body.state) is not None:
            yield Reading("garden_marker_blind_seconds", "Since the last ceiling marker", state.marker_blind_s)
