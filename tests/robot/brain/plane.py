"""Robots as points on a kinematic plane, each with its navigator, hearing one another once a second."""

import math
import random
from dataclasses import dataclass, field, replace

from core.allocation.right_of_way import RANK_DRIVING, RANK_IDLE, Other, in_the_way_of
from core.estimation.odometry import arc
from core.geometry.planar import Pose, distance_m
from core.robots import gardener
from core.robots.garden_map import GardenMap
from robot_service.ground import Ground
from robot_service.navigator import Navigator

DT_S = 0.08


@dataclass
class Walker:
    """Drives to `goal`, then idles there, giving way and coming back."""

    name: str
    pose: Pose
    goal: Pose
    ground: Ground
    phase_s: float
    silent: bool = False
    v: float = 0.0
    arrived_s: float | None = None
    nav: Navigator | None = None
    heard: dict[str, tuple[float, Other]] = field(default_factory=dict)
    polled_s: float = -1e9
    why: str = ""

    def __post_init__(self) -> None:
        self.nav = Navigator(self.ground, self.name, self.goal, RANK_DRIVING, False)

    @property
    def rank(self) -> int:
        return RANK_DRIVING if self.arrived_s is None else RANK_IDLE

    def word(self, now_s: float) -> Other:
        route = tuple(self.nav.route()) if self.nav else ()
        x, y, _ = self.pose
        return Other(
            robot_id=self.name, x_m=x, y_m=y, v_mps=abs(self.v), moving=abs(self.v) > 0.01, rank=self.rank, route=route
        )

    def others(self, now_s: float) -> list[Other]:
        return [replace(o, age_s=now_s - at) for at, o in self.heard.values()]

    def step(self, now_s: float, walkers: list["Walker"]) -> None:
        near = any(distance_m(self.pose, w.pose) < 1.6 for w in walkers if w is not self)
        every_s = (0.5 if near else 1.0) if self.nav else 2.0
        if now_s - self.polled_s >= every_s and now_s >= self.phase_s:
            self.polled_s = now_s
            self.heard |= {
                w.name: (now_s, w.word(now_s)) for w in walkers if w is not self and not (w.silent and w.name in self.heard)
            }
        if self.silent or now_s < self.phase_s:
            return
        others = self.others(now_s)
        if self.nav is None:
            self.v = 0.0
            away = distance_m(self.pose, self.goal) > 0.25
            if away or in_the_way_of((RANK_IDLE, self.name), self.pose, others):
                self.nav = Navigator(self.ground, self.name, self.goal, RANK_IDLE, False)
            return
        going = self.nav.step(self.pose, now_s, others)
        self.why = going.waiting
        assert not going.failed, (self.name, going.failed)
        self.v = going.v_mps
        self.pose = arc(self.pose, going.v_mps * DT_S, going.omega_radps * DT_S)
        if going.done:
            self.arrived_s = self.arrived_s or now_s
            self.nav = None


def walk(
    garden: GardenMap,
    tasks: list[tuple[Pose, Pose]],
    seed: int,
    within_s: float = 300.0,
    cell_m: float = 0.04,
    silent: frozenset[int] = frozenset(),
) -> tuple[float, float, list[Walker]]:
    """Everybody drives from start to goal. Returns (seconds, nearest two centres ever came, walkers)."""
    rng = random.Random(seed)
    walkers = [
        Walker(f"robot-{i + 1}", start, goal, Ground(garden, cell_m), rng.uniform(0.0, 1.0), i in silent)
        for i, (start, goal) in enumerate(tasks)
    ]
    now_s, closest_m = 0.0, math.inf
    while now_s < within_s and any(w.arrived_s is None and not w.silent for w in walkers):
        now_s += DT_S
        for walker in rng.sample(walkers, len(walkers)):
            walker.step(now_s, walkers)
        for i, a in enumerate(walkers):
            for b in walkers[i + 1 :]:
                closest_m = min(closest_m, distance_m(a.pose, b.pose))
    return now_s, closest_m, walkers


def free_poses(garden: GardenMap, count: int, rng: random.Random, apart_m: float) -> list[Pose]:
    """Random poses where a robot may stand, no two nearer than `apart_m`."""
    space = Ground(garden, 0.04).fixed()
    poses: list[Pose] = []
    while len(poses) < count:
        x = rng.uniform(-garden.length_m / 2, garden.length_m / 2)
        y = rng.uniform(-garden.width_m / 2, garden.width_m / 2)
        if space.is_free(x, y) and all(math.hypot(x - p[0], y - p[1]) > apart_m for p in poses):
            poses.append((x, y, rng.uniform(-math.pi, math.pi)))
    return poses


TOUCH_M = 2 * gardener.BODY_RADIUS_M
