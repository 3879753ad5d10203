"""What the judges of one soaked garden share: the truth, the promises that left it, and what they found broken."""

from __future__ import annotations

from dataclasses import dataclass, field

from lab.soak.faults import Gremlin, disk_failed
from lab.soak.garden import SoakGarden
from lab.soak.world import Truth

BREACHES_MAX = 20
STORY_EVENTS = 12


@dataclass(frozen=True, slots=True)
class Breach:
    """One broken invariant."""

    invariant: str
    at_s: float
    what: str
    story: tuple[str, ...] = ()
    """The task's own history, when one is concerned."""


@dataclass(frozen=True, slots=True)
class Given:
    """A permit as it left its plant."""

    permit_id: str
    task_id: str
    robot_id: str
    plant_id: str
    act: str
    epoch: int
    dose_ml: float
    issued_s: float
    until_s: float
    """When its act must have begun."""
    life: object
    """The life of its plant that said so."""


@dataclass(slots=True)
class Tally:
    """What happened, for the report."""

    tasks: int = 0
    done: int = 0
    failed: int = 0
    cancelled: int = 0
    doses: int = 0
    picks: int = 0
    requests: int = 0
    by_kind: dict[str, int] = field(default_factory=dict)


class Case:
    """`breaches` is what was found, each once."""

    def __init__(self, truth: Truth, gremlin: Gremlin) -> None:
        self.truth, self.gremlin = truth, gremlin
        self.garden: SoakGarden
        self.tally = Tally()
        self.breaches: list[Breach] = []
        self.permits: dict[str, Given] = {}
        self.awards: dict[tuple[str, int], str] = {}
        """The robot that a task was awarded to, by task and epoch."""
        self.declined: set[tuple[str, int]] = set()
        """Awards that a robot declined because its bid held no more, by task and epoch: they changed no hands."""
        self.born_s: dict[str, float] = {}
        """When a task was first seen; what it says itself is by a clock that may be gone."""
        self.stopped: set[str] = set()
        """Robots whose e-stop was confirmed and not released since."""

    def breach(self, invariant: str, what: str) -> None:
        if len(self.breaches) < BREACHES_MAX and all(b.invariant != invariant or b.what != what for b in self.breaches):
            self.breaches.append(Breach(invariant, self.truth.now(), what, self._story(what)))

    def _story(self, what: str) -> tuple[str, ...]:
        for plant_id in self.garden.names("plant"):
            pot = self.garden.pot(plant_id)
            for task in pot.place.market.tasks() if pot is not None else ():
                if f"{task.task_id} " in f"{what} ":
                    told = [(self.loop_s(plant_id, event.t_s), event) for event in task.events[-STORY_EVENTS:]]
                    return tuple(f"{at_s:.1f} {event.robot_id} {event.epoch}: {event.what}" for at_s, event in told)
        return ()

    def away(self, name: str) -> bool:
        """Dead, asleep, or waiting for somebody to mend its disk."""
        running = self.garden.running.get(name)
        return running is None or running.life.stopped or disk_failed(running)

    def loop_s(self, plant_id: str, garden_s: float) -> float:
        """A running plant's time as that of the loop."""
        clock = self.garden.running[plant_id].life.clock
        return (garden_s - clock.offset_s) / clock.rate
