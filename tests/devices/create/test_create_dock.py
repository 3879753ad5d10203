"""The seek-dock firmware on a plane: it sees only beams, bumps and contacts."""

import math
import random

import pytest

from sim.devices.bench import BenchCreate, Pose
from sim.devices.create_dock import DockSeeker, Phase, Side
from sim.devices.plants import CreateSense

TICK_S = 0.015
WHEELBASE_M = 0.235


def start(rng: random.Random) -> Pose:
    """Somewhere before the dock, more or less facing it."""
    return Pose(-rng.uniform(0.4, 1.0), rng.uniform(-0.25, 0.25), math.radians(rng.uniform(-40.0, 40.0)))


def seconds_to_mate(seed: int, red_side: Side = "left", within_s: float = 30.0, **geometry: float) -> float:
    """Garden seconds until the contacts touch, inf if they do not in time."""
    rng = random.Random(seed)
    body = BenchCreate(rng, pose=start(rng), red_side=red_side, wheel_noise=0.05, **geometry)
    seeker = DockSeeker(rng, red_side, WHEELBASE_M)
    now_s = 0.0
    while now_s < within_s:
        wheels = seeker.update(now_s, body.sense())
        if seeker.done:
            return now_s
        body.set_wheels(*wheels)
        now_s += TICK_S
        body.advance(now_s)
    return math.inf


@pytest.mark.parametrize("red_side", ["left", "right"])
def test_it_mates_from_a_hundred_starts_within_thirty_seconds(red_side: Side) -> None:
    times = {seed: seconds_to_mate(seed, red_side) for seed in range(100)}
    failed = [seed for seed, time_s in times.items() if math.isinf(time_s)]
    assert not failed, f"seeds {failed}"
    assert sorted(times.values())[50] < 12.0


@pytest.mark.parametrize(
    "geometry", [{"apex_m": 0.16}, {"apex_m": 0.274}, {"receiver_m": 0.10}, {"receiver_m": 0.15}], ids=str
)
def test_it_does_not_depend_on_where_emitter_and_receiver_sit(geometry: dict[str, float]) -> None:
    failed = [seed for seed in range(30) if math.isinf(seconds_to_mate(seed, **geometry))]
    assert not failed, f"seeds {failed}"


def test_with_the_beams_swapped_it_does_not_mate() -> None:
    rng = random.Random(5)
    body = BenchCreate(rng, pose=Pose(-0.8, 0.1, 0.2), red_side="right")
    seeker = DockSeeker(rng, "left", WHEELBASE_M)
    for tick in range(700):
        body.set_wheels(*seeker.update(tick * TICK_S, body.sense()))
        body.advance(tick * TICK_S)
    assert not seeker.done


def test_a_bump_at_the_dock_makes_it_back_off_and_try_again() -> None:
    seeker = DockSeeker(random.Random(1), "left", WHEELBASE_M)
    seeker.update(0.0, CreateSense(ir_red=True, ir_green=True, ir_field=True))
    left, right = seeker.update(TICK_S, CreateSense(ir_red=True, ir_field=True, bump_left=True))
    assert left == right < 0
    seeker.update(2 * TICK_S, CreateSense(ir_red=True, ir_field=True, left_m=-0.3, right_m=-0.3))
    assert seeker.phase is Phase.FOLLOW


def test_a_cliff_makes_it_back_off_and_turn_away() -> None:
    seeker = DockSeeker(random.Random(1), "left", WHEELBASE_M)
    left, right = seeker.update(0.0, CreateSense(cliff_front_right=True))
    assert left == right < 0
    seeker.update(TICK_S, CreateSense(left_m=-0.2, right_m=-0.2))
    left, right = seeker.update(2 * TICK_S, CreateSense(left_m=-0.2, right_m=-0.2))
    assert left < 0 < right, "away from the right-hand edge"


def test_without_any_dock_it_spins_then_looks_elsewhere() -> None:
    rng = random.Random(3)
    body = BenchCreate(rng, dock=False)
    seeker = DockSeeker(rng, "left", WHEELBASE_M)
    seen = set()
    for tick in range(1500):
        body.set_wheels(*seeker.update(tick * TICK_S, body.sense()))
        body.advance(tick * TICK_S)
        seen.add(seeker.phase)
    assert {Phase.SPIN, Phase.TURN, Phase.ROAM} <= seen
    assert Phase.DONE not in seen
