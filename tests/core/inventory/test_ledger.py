"""Merging scans: identity over days, evidence for and against, and what leaves."""

from __future__ import annotations

import itertools
import math
import random
from dataclasses import dataclass, field

from hypothesis import given, settings
from hypothesis import strategies as st

from core.growth.belief import Pace
from core.growth.stages import COLOURS, DAY_S
from core.inventory.ledger import FLOOR, Merged, merge
from core.inventory.matching import assign
from core.inventory.track import Track
from core.inventory.view import in_view
from core.wire.fruit import Accuracy, Colour, Direction, Scan, Sighting, View

EYES = [(0.45, y, z) for z in (0.12, 0.32) for y in (-0.15, 0.0, 0.15)]
"""Six camera poses before the plant, as in the paper."""


def view(eye: tuple[float, float, float]) -> View:
    return View(
        x_m=eye[0], y_m=eye[1], z_m=eye[2], look=Direction(x=-1.0, y=0.0, z=0.0), up=Direction(x=0.0, y=0.0, z=1.0),
        fov_x_rad=1.6, fov_y_rad=1.4,
    )  # fmt: skip


@dataclass
class Tomato:
    """The truth about one fruit, and the views that leaves hide it from."""

    p: tuple[float, float, float]
    colour: Colour = "green"
    radius_m: float = 0.013
    hidden: frozenset[int] = frozenset()


@dataclass
class Plant:
    """Its fruit as they are, and its inventory as scans have made it."""

    fruit: list[Tomato]
    rng: random.Random
    tracks: list[Track] = field(default_factory=list)
    now_s: float = 1000.0
    recall: float = 1.0
    used: int = 0

    def name(self) -> str:
        self.used += 1
        return f"f{self.used}"

    def sight(self, tomato: Tomato, bias: tuple[float, float, float], sigma_m: float = 0.004) -> Sighting | None:
        seen = [i for i in range(6) if i not in tomato.hidden and self.rng.random() < self.recall]
        x, y, z = (a + b + self.rng.gauss(0.0, sigma_m) for a, b in zip(tomato.p, bias, strict=True))
        if not seen:
            return None
        return Sighting(
            x_m=x, y_m=y, z_m=z, sigma_m=sigma_m, colour=tomato.colour, confidence=0.9, views=seen,
            radius_m=tomato.radius_m * (1.0 + self.rng.gauss(0.0, 0.05)),
        )  # fmt: skip

    def scan(self, bias: tuple[float, float, float] = (0.0, 0.0, 0.0), **more: object) -> Merged:
        sightings = [s for tomato in self.fruit if (s := self.sight(tomato, bias)) is not None]
        self.rng.shuffle(sightings)
        scan = Scan(scan_id=f"s{self.now_s}", views=[view(eye) for eye in EYES], sightings=sightings,
                    detector=Accuracy(recall=0.8, precision=0.9))  # fmt: skip
        merged = merge(self.tracks, scan, Pace(), self.now_s, self.name, **more)  # type: ignore[arg-type]
        self.tracks = merged.tracks
        return merged

    def of(self, tomato: Tomato) -> Track:
        return min(self.tracks, key=lambda track: math.dist(track.p, tomato.p))


def truss(count: int, rng: random.Random) -> list[Tomato]:
    """Fruit some 35 to 45 mm apart."""
    fruit = []
    for i in range(count):
        place = (0.1 + rng.uniform(-0.01, 0.01), -0.1 + 0.04 * (i % 6), 0.15 + 0.045 * (i // 6))
        fruit.append(Tomato(place, COLOURS[i % 3], rng.uniform(0.011, 0.015)))
    return fruit


seeds = st.integers(0, 10_000)


@settings(max_examples=10, deadline=None)
@given(seeds, st.tuples(*[st.floats(-0.012, 0.012)] * 3))
def test_identity_is_kept_over_days_though_fruit_sag_grow_and_the_robot_stands_askew(
    seed: int, bias: tuple[float, float, float]
) -> None:
    rng = random.Random(seed)
    plant = Plant(truss(12, rng), rng)
    plant.scan()
    names = [plant.of(tomato).fruit.fruit_id for tomato in plant.fruit]
    assert sorted(names) == sorted({f"f{i + 1}" for i in range(12)})
    for day in range(1, 5):
        plant.now_s += DAY_S
        for tomato in plant.fruit:
            tomato.p = (tomato.p[0], tomato.p[1], tomato.p[2] - 0.003)
            tomato.radius_m *= 1.02
        merged = plant.scan(bias if day % 2 else (0.0, 0.0, 0.0))
        assert (merged.new, merged.left) == ([], []), f"seed {seed}, day {day}"
    assert [plant.of(tomato).fruit.fruit_id for tomato in plant.fruit] == names


def test_a_fruit_is_surer_each_time_it_is_seen_and_its_place_finer() -> None:
    plant = Plant([Tomato((0.1, 0.0, 0.2))], random.Random(1))
    told = []
    for _ in range(4):
        plant.scan()
        told.append((plant.tracks[0].fruit.confidence, -plant.tracks[0].fruit.sigma_m))
        plant.now_s += 600.0
    assert told == sorted(told)
    assert told[0] < told[-1]
    assert plant.tracks[0].fruit.seen_count == 4


def test_a_fruit_that_was_seen_from_here_and_is_gone_leaves_within_three_scans() -> None:
    plant = Plant(truss(6, random.Random(2)), random.Random(2))
    for _ in range(4):
        plant.scan()
        plant.now_s += 3600.0
    gone = plant.fruit.pop(2)
    name, before = plant.of(gone).fruit.fruit_id, plant.of(gone).fruit.confidence
    plant.scan()
    after = next((t.fruit.confidence for t in plant.tracks if t.fruit.fruit_id == name), 0.0)
    assert after < before
    left = [*plant.scan().left, *plant.scan().left]
    assert [entry.fruit_id for entry in left] == [name]
    assert len(plant.tracks) == 5


def test_where_a_leaf_hangs_before_a_fruit_its_absence_tells_nothing() -> None:
    hidden, open_to_all = Tomato((0.1, -0.1, 0.2), hidden=frozenset(range(1, 6))), Tomato((0.1, 0.1, 0.2))
    plant = Plant([hidden, open_to_all], random.Random(3))
    for _ in range(4):
        plant.scan()
        plant.now_s += 3600.0
    names = [plant.of(tomato).fruit.fruit_id for tomato in (hidden, open_to_all)]
    before = [plant.of(tomato).fruit.confidence for tomato in (hidden, open_to_all)]
    plant.fruit = []
    others = [view(eye) for eye in EYES[1:]]
    scan = Scan(scan_id="s", views=others, detector=Accuracy(recall=0.8, precision=0.9))
    after = {t.fruit.fruit_id: t.fruit.confidence for t in merge(plant.tracks, scan, Pace(), plant.now_s, plant.name).tracks}
    assert before[0] - after[names[0]] < 0.05 < before[1] - after.get(names[1], 0.0)


def test_a_fruit_outside_every_picture_stays_as_it_was() -> None:
    plant = Plant([Tomato((0.1, 0.0, 0.2))], random.Random(4))
    plant.scan()
    before = plant.tracks[0].fruit
    scan = Scan(scan_id="away", views=[view((0.45, 2.0, 0.2))])
    after = merge(plant.tracks, scan, Pace(), plant.now_s + 60.0, plant.name).tracks
    assert [t.fruit for t in after] == [before]


def test_one_missed_detection_among_many_views_drops_nobody() -> None:
    rng = random.Random(5)
    plant = Plant(truss(12, rng), rng, recall=0.75)
    for _ in range(12):
        plant.scan()
        plant.now_s += 6 * 3600.0
    assert len(plant.tracks) == 12
    assert plant.used <= 13


def test_red_stays_red_and_a_single_slip_of_the_detector_changes_no_colour() -> None:
    plant = Plant([Tomato((0.1, 0.0, 0.2), "red"), Tomato((0.1, 0.1, 0.2), "green")], random.Random(6))
    for _ in range(3):
        plant.scan()
        plant.now_s += 3600.0
    plant.fruit[0].colour, plant.fruit[1].colour = "turning", "red"
    plant.scan()
    assert sorted(t.fruit.colour for t in plant.tracks) == ["green", "red"]
    assert len(plant.tracks) == 2


def test_a_green_fruit_that_turns_and_reddens_is_the_same_one() -> None:
    plant = Plant([Tomato((0.1, 0.0, 0.2), "green")], random.Random(7))
    said = []
    for colour in ("green", "green", "turning", "turning", "turning", "turning", "turning", "red", "red"):
        plant.fruit[0].colour = colour
        plant.scan()
        said.append(plant.tracks[0].fruit.colour)
        plant.now_s += DAY_S
    assert [t.fruit.fruit_id for t in plant.tracks] == ["f1"]
    assert [key for key, _ in itertools.groupby(said)] == ["green", "turning", "red"]


def test_a_fruit_whose_truss_was_pushed_aside_is_the_same_one_elsewhere() -> None:
    rng = random.Random(12)
    plant = Plant(truss(12, rng), rng)
    for _ in range(3):
        plant.scan()
        plant.now_s += 3600.0
    pushed = plant.fruit[7]
    name, hung = plant.of(pushed).fruit.fruit_id, pushed.p
    pushed.p = (hung[0] + 0.03, hung[1], hung[2] + 0.025)
    merged = plant.scan()
    assert (merged.new, merged.left) == ([], [])
    assert plant.of(pushed).fruit.fruit_id == name
    assert math.dist(plant.of(pushed).p, pushed.p) < 0.01


def test_a_small_new_fruit_is_not_taken_for_a_large_one_that_has_gone() -> None:
    rng = random.Random(13)
    plant = Plant(truss(6, rng), rng)
    for _ in range(3):
        plant.scan()
        plant.now_s += 3600.0
    gone = plant.fruit.pop(3)
    name = plant.of(gone).fruit.fruit_id
    plant.fruit.append(Tomato((gone.p[0] + 0.03, gone.p[1], gone.p[2]), "green", 0.005))
    merged = plant.scan()
    assert merged.new
    assert name not in merged.new


def test_a_fruit_told_twice_in_one_scan_is_listed_once() -> None:
    rng = random.Random(8)
    plant = Plant([Tomato((0.1, 0.0, 0.2))], rng)
    twin = Tomato((0.1, 0.006, 0.2))
    plant.fruit.append(twin)
    plant.scan()
    plant.scan()
    assert len(plant.tracks) == 1


def doubtful(plant: Plant) -> None:
    plant.tracks = [track.with_fruit(in_doubt=True) for track in plant.tracks]


def test_a_scan_decides_a_doubt_either_way_and_an_early_one_does_not() -> None:
    for gone in (False, True):
        plant = Plant([Tomato((0.1, 0.0, 0.2), "red")], random.Random(9))
        plant.scan()
        doubtful(plant)
        if gone:
            plant.fruit = []
        early = plant.scan(undecided=["f1"])
        assert early.settled == {}
        assert plant.tracks[0].fruit.in_doubt
        merged = plant.scan()
        assert merged.settled == {"f1": not gone}
        assert [t.fruit.in_doubt for t in plant.tracks] == ([] if gone else [False])


def test_a_fruit_in_doubt_that_no_view_can_show_is_given_up_after_three_scans() -> None:
    plant = Plant([Tomato((0.1, 0.0, 0.2), "red")], random.Random(10))
    plant.scan()
    doubtful(plant)
    tracks, settled = plant.tracks, []
    for i in range(3):
        scan = Scan(scan_id=f"away{i}", views=[view((0.45, 2.0, 0.2))])
        merged = merge(tracks, scan, Pace(), plant.now_s, plant.name)
        tracks = merged.tracks
        settled.append(merged.settled)
    assert settled == [{}, {}, {"f1": False}]


@settings(max_examples=60, deadline=None)
@given(seeds, st.integers(1, 6), st.integers(1, 6), st.floats(0.2, 1.0))
def test_the_assignment_is_the_best_of_all(seed: int, rows: int, columns: int, density: float) -> None:
    rng = random.Random(seed)
    costs = {(r, c): rng.uniform(0.0, 20.0) for r in range(rows) for c in range(columns) if rng.random() < density}
    pairs = assign(costs, rows, 12.0)
    assert len(set(pairs.values())) == len(pairs)

    def total(chosen: dict[int, int]) -> float:
        return sum(costs[pair] for pair in chosen.items()) + 12.0 * (rows - len(chosen))

    def all_ways(row: int, free: frozenset[int]) -> float:
        if row == rows:
            return 0.0
        ways = [12.0 + all_ways(row + 1, free)]
        ways += [costs[row, c] + all_ways(row + 1, free - {c}) for c in free if (row, c) in costs]
        return min(ways)

    assert math.isclose(total(pairs), all_ways(0, frozenset(range(columns))), abs_tol=1e-9), f"seed {seed}"


def test_two_hundred_fruit_are_told_apart() -> None:
    rng = random.Random(11)
    places = [(0.1, -0.45 + 0.045 * (i % 20), 0.05 + 0.045 * (i // 20)) for i in range(200)]
    plant = Plant([Tomato(p) for p in places], rng)
    plant.scan()
    plant.scan()
    assert len(plant.tracks) == 200
    assert all(track.fruit.confidence > FLOOR for track in plant.tracks)


def test_a_fruit_that_one_of_six_views_shows_counts_once_it_is_seen_again():
    lone = Tomato((0.05, 0.0, 0.2), hidden=frozenset(range(1, 6)))
    plant = Plant([lone], random.Random(5))
    plant.scan()
    assert plant.of(lone).fruit.confidence < 0.5
    plant.now_s += 3600.0
    plant.scan()
    assert plant.of(lone).fruit.confidence >= 0.5


def test_a_fruit_that_two_views_show_counts_at_once():
    shown = Tomato((0.05, 0.0, 0.2), hidden=frozenset(range(2, 6)))
    plant = Plant([shown], random.Random(5))
    plant.scan()
    assert plant.of(shown).fruit.confidence > 0.8


def test_what_one_picture_shows_at_its_edge_is_doubted_and_goes_when_it_is_not_seen_there_again() -> None:
    places = [(0.05, y / 100, z / 100) for y in range(-60, 61) for z in range(-10, 60)]
    edge = next(p for p in places if not any(in_view(view(eye), p) for eye in EYES))
    plant = Plant([Tomato(edge, hidden=frozenset(range(1, 6)))], random.Random(6))
    plant.scan()
    assert plant.tracks[0].fruit.confidence < 0.5
    plant.fruit = []
    left = [entry for _ in range(3) for entry in plant.scan().left]
    assert [entry.fruit_id for entry in left] == ["f1"]


def test_a_scan_of_one_picture_is_believed_but_at_its_edge() -> None:
    middle, edge = (0.1, 0.0, 0.12), (0.1, 0.0, 0.12 + 0.35 * math.tan(0.67))
    seen = [
        Sighting(x_m=x, y_m=y, z_m=z, sigma_m=0.01, radius_m=0.013, colour="red", confidence=0.9, views=[0])
        for x, y, z in (middle, edge)
    ]
    scan = Scan(scan_id="one", views=[view((0.45, 0.0, 0.12))], sightings=seen)
    tracks = merge([], scan, Pace(), 1000.0, iter("ab").__next__).tracks
    sure, doubted = (track.fruit.confidence for track in sorted(tracks, key=lambda track: track.p[2]))
    assert doubted < 0.6 < 0.8 < sure
