"""What a service's `/metrics` tells beside its requests: read from its state when somebody asks, at no cost in between."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field

from prometheus_client import CollectorRegistry
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from core.mesh.client import Mesh
from core.mesh.events import EventLog

LAG_EVERY_S = 0.5
LAG_KEPT = 120
"""A minute's worth."""


@dataclass(frozen=True, slots=True)
class Reading:
    """One number. Its name ends in its unit, or in `_total` when it only grows."""

    name: str
    told: str
    value: float
    labels: Mapping[str, str] = field(default_factory=dict)


class Readings(Collector):
    """Makes Prometheus families of what `read` yields; readings of one name share their label names."""

    def __init__(self, read: Callable[[], Iterable[Reading]]) -> None:
        self._read = read

    def collect(self) -> Iterator[Metric]:
        families: dict[str, GaugeMetricFamily | CounterMetricFamily] = {}
        for one in self._read():
            if (family := families.get(one.name)) is None:
                kind = CounterMetricFamily if one.name.endswith("_total") else GaugeMetricFamily
                family = families[one.name] = kind(one.name, one.told, labels=list(one.labels))
            family.add_metric(list(one.labels.values()), one.value)
        yield from families.values()


def measure(registry: CollectorRegistry, read: Callable[[], Iterable[Reading]]) -> None:
    """Let `/metrics` tell what `read` yields at each scrape."""
    registry.register(Readings(read))


def of_mesh(mesh: Mesh) -> Iterator[Reading]:
    """Requests to peers and how they ended."""
    for (peer, outcome), count in sorted(mesh.outcomes.items()):
        labels = {"peer": peer, "outcome": outcome}
        yield Reading("garden_mesh_requests_total", "Requests to peers: answered, refused, silent", count, labels)


def of_events(events: EventLog) -> Iterator[Reading]:
    for kind, count in sorted(events.counts.items()):
        yield Reading("garden_events_total", "What happened here, by kind", count, {"kind": kind})


class LoopLag:
    """How late the event loop wakes whoever sleeps on it: the worst of the last minute [s of the machine]."""

    def __init__(self) -> None:
        self._lags_s: deque[float] = deque(maxlen=LAG_KEPT)

    async def run(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            due_s = loop.time() + LAG_EVERY_S
            await asyncio.sleep(LAG_EVERY_S)
            self._lags_s.append(max(0.0, loop.time() - due_s))

    def readings(self) -> Iterator[Reading]:
        yield Reading("garden_loop_lag_seconds", "Worst wake-up of the last minute", max(self._lags_s, default=0.0))
