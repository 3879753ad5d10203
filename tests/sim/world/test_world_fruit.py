"""Fruit in the world: it hangs, is gripped by friction alone, torn off by force, carried, dropped, grown and kept."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Iterator

import mujoco
import numpy as np
import pytest

from core.robots import gardener as g
from core.scenario import Climate, Scenario, find
from sim.faults import FaultBoard, FaultRequest
from sim.growth import STRENGTH_SPREAD, flower
from sim.physics.fruit import NEAR_M, Spot
from sim.scene.tomato import RED_FROM, TURNING_FROM
from sim.truth import FruitTruth
from sim.world import World

ROBOT, PLANT = "robot-1", "plant-1"
RED_N = (0.4, 2.46)
"""Published pulls that take a ripe cherry tomato off its calyx: 0.58 to 2.46 N; overripe ones come off for less."""
RAISED_RAD = tuple(math.radians(angle) for angle in (0.0, 110.0, -100.0, 0.0))
DAY_S = 86400.0
Arm = dict[str, float]


# A hand that knows where things are


def plane(reach_m: float, z_m: float, pitch_rad: float) -> Arm | None:
    """Joint angles that bring the tool to (reach, z) from the shoulder axis with the hand at `pitch_rad`; None: cannot."""
    x = reach_m - g.HAND_M * math.cos(pitch_rad)
    z = z_m - g.HAND_M * math.sin(pitch_rad)
    upper, fore = g.UPPER_ARM_M, g.FOREARM_M
    cos = (x * x + z * z - upper * upper - fore * fore) / (2 * upper * fore)
    if abs(cos) > 1.0:
        return None
    elbow = -math.acos(cos)
    shoulder = math.atan2(z, x) - math.atan2(fore * math.sin(elbow), upper + fore * math.cos(elbow))
    arm = {"shoulder": shoulder, "elbow": elbow, "wrist": pitch_rad - shoulder - elbow}
    return arm if all(g.SERVOS[name].min_rad <= a <= g.SERVOS[name].max_rad for name, a in arm.items()) else None


def move(world: World, goal: Arm, seconds: float) -> Iterator[None]:
    """Leads the servos along a straight line in joint space, tick by tick."""
    start = {name: world.robots[ROBOT].arm.now_rad[name] for name in goal}
    ticks = max(1, round(seconds / 0.02))
    for tick in range(1, ticks + 1):
        for name, end in goal.items():
            servo = g.SERVOS[name]
            angle = start[name] + (end - start[name]) * tick / ticks
            world.servo_rig(ROBOT).set_pulse(servo.channel, servo.pulse_us(angle))
        world.advance(0.02)
        yield


def go(world: World, goal: Arm, seconds: float) -> None:
    for _ in move(world, goal, seconds):
        pass


def named(angles: tuple[float, ...]) -> Arm:
    return dict(zip(g.ARM_JOINTS, angles, strict=True))


def dock(world: World, plant_id: str = PLANT) -> None:
    pose = world.scenario.docks()[plant_id]
    world.teleport(ROBOT, pose.x_m, pose.y_m, pose.yaw_rad)
    world.advance(0.3)


def reach(world: World, spot: Spot) -> list[Arm] | None:
    """Before the fruit, at it, pulled back: a straight line along the hand; None when no pitch of the hand will do."""
    x, y, z = world.orchard.position_m(spot)
    ahead, left = world.robots[ROBOT].pose.local(x, y)
    pan, far = math.atan2(left, ahead - g.SHOULDER_X_M), math.hypot(left, ahead - g.SHOULDER_X_M)
    for pitch in (0.0, -0.2, 0.2, -0.4, 0.4):
        line = [
            plane(far - back * math.cos(pitch), z - g.SHOULDER_Z_M - back * math.sin(pitch), pitch)
            for back in (0.07, 0.0, 0.09)
        ]
        if all(line) and abs(pan) < g.SERVOS["pan"].max_rad:
            return [arm | {"pan": pan} for arm in line if arm is not None]
    return None


def grasp(world: World, spot: Spot) -> list[Arm] | None:
    """Hand at the fruit, gripper closed; the line it came along, or None when it cannot be reached."""
    line = reach(world, spot)
    if line is None:
        return None
    go(world, {"gripper": g.SERVOS["gripper"].max_rad} | named((line[0]["pan"], *RAISED_RAD[1:])), 1.5)
    go(world, line[0], 1.5)
    go(world, line[1], 0.8)
    world.advance(0.2)
    go(world, {"gripper": 0.0}, 0.8)
    world.advance(0.3)
    return line


def pull(world: World, spot: Spot, line: list[Arm]) -> float:
    """Straight back along the hand; the hardest pull that the stalk bore [N]."""
    peak_n = 0.0
    for _ in move(world, line[2], 1.2):
        peak_n = max(peak_n, world.orchard.pull_n(spot))
    world.advance(0.2)
    return peak_n


def lay_into_basket(world: World, line: list[Arm]) -> None:
    go(world, named((line[0]["pan"], *RAISED_RAD[1:])), 1.2)
    go(world, named(g.ARM_BASKET_RAD), 1.5)
    world.advance(0.2)
    go(world, {"gripper": g.SERVOS["gripper"].max_rad}, 0.8)
    world.advance(1.0)
    go(world, named(g.ARM_HOME_RAD), 1.5)


def reds(world: World, plant_id: str | None = None) -> list[Spot]:
    return [
        spot
        for spot in world.orchard.spots
        if spot.there and spot.hangs and spot.growing.colour == "red" and plant_id in (None, spot.plant_id)
    ]


def fact(world: World, spot: Spot) -> FruitTruth:
    fruit = world.truth().plant(spot.plant_id).fruit
    return next(one for one in fruit if one.id == spot.growing.fruit_id)


def first_red(world: World) -> Spot:
    """The nearest ripe fruit within reach of the docked robot."""
    dock(world)
    return next(spot for spot in reds(world, PLANT) if reach(world, spot) is not None)


# Hanging


def test_fruit_hangs_still_below_its_joint_by_its_own_weight(world: World) -> None:
    world.advance(1.0)
    for spot in world.orchard.spots:
        if spot.there:
            knuckle = world.data.site_xpos[spot.knuckle]
            x, y, z = world.orchard.position_m(spot)
            assert math.hypot(x - knuckle[0], y - knuckle[1]) < 1e-3
            assert knuckle[2] - z == pytest.approx(spot.stalk_m + spot.drawn_m, abs=1e-3)
            assert world.orchard.pull_n(spot) == pytest.approx(float(world.model.body_mass[spot.body]) * 9.81, rel=0.02)
    assert world.at_rest
    asleep = world.data.tree_asleep >= 0
    assert asleep.sum() == len(world.orchard.spots)


def test_no_two_fruit_overlap_in_any_garden() -> None:
    for seed in range(3):
        world = World(find("garden"), seed)
        balls = [(world.orchard.position_m(spot), spot.drawn_m) for spot in world.orchard.spots if spot.there]
        for nth, (p, r) in enumerate(balls):
            assert all(math.dist(p, q) > r + s for q, s in balls[:nth]), f"seed {seed}"


# Picking


def test_a_fruit_is_gripped_with_six_newtons_torn_off_by_force_and_laid_into_the_basket(
    world: World, quiet: Callable[[World], None]
) -> None:
    spot = first_red(world)
    strength_n = spot.growing.strength_n
    line = grasp(world, spot)
    assert line is not None
    assert world.robots[ROBOT].arm.grip_n() == pytest.approx(6.0, abs=0.5)
    assert world.robots[ROBOT].analog_v(g.FORCE_INPUT) == pytest.approx(0.4 * 6.0, abs=0.25)
    assert fact(world, spot).where == "plant"
    peak_n = pull(world, spot, line)
    held = fact(world, spot)
    assert (held.where, held.robot_id, held.torn_by, held.torn_how) == ("hand", ROBOT, ROBOT, "grip")
    assert 0.4 * strength_n < peak_n <= strength_n
    assert RED_N[0] < peak_n < RED_N[1]
    lay_into_basket(world, line)
    laid = fact(world, spot)
    assert (laid.where, laid.robot_id) == ("basket", ROBOT)
    robot = world.truth().robot(ROBOT)
    assert robot.torn_gripped.red == 1
    world.advance(6.0)
    assert world.at_rest
    quiet(world)


def test_a_fruit_in_the_basket_rides_along(world: World) -> None:
    spot = first_red(world)
    line = grasp(world, spot)
    assert line is not None
    pull(world, spot, line)
    lay_into_basket(world, line)
    for left_mps, right_mps in ((-0.3, -0.3), (0.2, -0.2), (0.3, 0.3), (0.0, 0.0)):
        world.create_body(ROBOT).set_wheels(left_mps, right_mps)
        world.advance(1.5)
    assert (fact(world, spot).where, fact(world, spot).robot_id) == ("basket", ROBOT)


def test_an_emptied_basket_is_told_and_the_place_flowers_again(world: World) -> None:
    spot = first_red(world)
    fruit_id = spot.growing.fruit_id
    line = grasp(world, spot)
    assert line is not None
    pull(world, spot, line)
    lay_into_basket(world, line)
    assert fruit_id in world.take(ROBOT)
    plant = world.truth().plant(PLANT)
    assert fruit_id not in {fruit.id for fruit in plant.fruit}
    assert (fruit_id, "taken", ROBOT, "red") in {(gone.id, gone.how, gone.robot_id, gone.colour) for gone in plant.gone}
    assert all(fruit.where != "basket" for fruit in plant.fruit)
    # A neighbour that fell on the way rolls for a while.
    world.advance(4.0)
    assert world.at_rest
    assert spot.hangs
    assert not spot.there


def test_a_green_fruit_holds_against_a_pull_that_takes_a_red_one(world: World) -> None:
    rng = np.random.default_rng(1)
    for _ in range(50):
        fruit = flower("x", 0.0, rng)
        by_age = []
        for age in (
            fruit.green_days / 2,
            fruit.green_days + 0.5 * fruit.turning_days,
            fruit.green_days + fruit.turning_days,
        ):
            fruit.age_days = age
            by_age.append(fruit.strength_n)
        assert by_age[0] > by_age[1] > by_age[2]
        assert 5.0 * 0.99 <= by_age[0] <= 8.1
        assert by_age[2] <= 2.46 + 1e-9
        assert by_age[2] >= 2.0 * (1 - STRENGTH_SPREAD) - 1e-9


def test_a_bent_joint_bears_half_and_a_cut_stalk_lets_the_fruit_fall_to_the_ground(world: World) -> None:
    spot = reds(world, PLANT)[0]
    full_n = world.orchard.strength_n(spot)
    assert full_n == pytest.approx(spot.growing.strength_n, rel=0.02)
    start = world.snapshot()
    world.data.qpos[spot.qpos + 3 : spot.qpos + 7] = (math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0)
    world.data.qpos[spot.qpos + 2] += spot.drawn_m
    mujoco.mj_forward(world.model, world.data)
    assert world.orchard.strength_n(spot) == pytest.approx(0.5 * full_n, rel=0.25)
    world.restore(start)
    assert world.orchard.strength_n(spot) == pytest.approx(full_n, rel=0.02)
    world.orchard.cut(spot)
    world.advance(0.1)
    assert not world.at_rest
    world.advance(6.0)
    assert world.at_rest
    lying = fact(world, spot)
    assert lying.where == "ground"
    assert lying.position_world.z_m < g.SOIL_HEIGHT_M + 0.02
    assert lying.torn_by is None
    assert world.truth().plant(PLANT).dropped.red == 1


def test_a_slippery_grip_loses_the_fruit_and_a_stuck_sensor_says_nothing_new(world: World) -> None:
    spot = first_red(world)
    board = FaultBoard(world, {})
    board.add(FaultRequest(kind="force_stuck", target=ROBOT))
    slips = board.add(FaultRequest(kind="slippery_grip", target=ROBOT))
    volts = world.robots[ROBOT].analog_v(g.FORCE_INPUT)
    line = grasp(world, spot)
    assert line is not None
    assert world.robots[ROBOT].analog_v(g.FORCE_INPUT) == volts
    pull(world, spot, line)
    assert fact(world, spot).where != "hand"
    for fault in board.all():
        board.remove(fault.id)
    assert slips.strength == pytest.approx(0.08)
    world.advance(0.1)
    assert world.robots[ROBOT].analog_v(g.FORCE_INPUT) != volts
    assert world.model.geom(f"{ROBOT}/pad-left").friction[0] == 1.0


def test_pushed_branches_carry_their_fruit_to_and_fro_and_come_back(world: World) -> None:
    spot = reds(world, PLANT)[0]
    before = world.orchard.position_m(spot)
    board = FaultBoard(world, {})
    fault = board.add(FaultRequest(kind="branch_sway", target=PLANT, strength=0.03))
    assert not world.at_rest
    away = 0.0
    for _ in range(25):
        world.advance(0.1)
        away = max(away, math.dist(before, world.orchard.position_m(spot)))
    assert 0.02 < away < 0.05
    board.remove(fault.id)
    world.advance(14.0)
    assert world.at_rest
    assert math.dist(before, world.orchard.position_m(spot)) < 1e-3
    assert spot.hangs


def test_a_rolling_wrist_twists_a_fruit_on_its_stalk_and_weakens_the_joint() -> None:
    garden = find("garden")
    robots = tuple(robot.model_copy(update={"wrist": "roll"}) for robot in garden.robots)
    world = World(garden.model_copy(update={"robots": robots}), 7)
    spot = first_red(world)
    line = grasp(world, spot)
    assert line is not None
    before_n = world.orchard.strength_n(spot)
    servo = g.ROLL_SERVO
    for tick in range(1, 26):
        world.servo_rig(ROBOT).set_pulse(servo.channel, servo.pulse_us(math.radians(60.0) * tick / 25))
        world.advance(0.02)
    world.advance(0.3)
    assert world.robots[ROBOT].arm.now_rad["roll"] == pytest.approx(math.radians(60.0))
    assert world.orchard.strength_n(spot) < before_n - 0.1 or not spot.hangs
    pull(world, spot, line)
    assert fact(world, spot).where == "hand"


# Time and keeping


def test_the_same_seed_tears_the_same_fruit_in_the_same_way(world: World) -> None:
    start = world.snapshot()

    def play() -> tuple[object, ...]:
        world.restore(start)
        spot = first_red(world)
        line = grasp(world, spot)
        assert line is not None
        return pull(world, spot, line), world.truth().model_dump_json(), world.data.qpos.tolist()

    assert play() == play()


def tales(world: World) -> list[tuple[object, ...]]:
    """What is so of every fruit, but for its exact place."""
    return [
        (fruit.id, fruit.where, fruit.robot_id, fruit.torn_by, fruit.torn_how, fruit.ripeness, fruit.radius_m)
        for plant in world.truth().plants
        for fruit in plant.fruit
    ]


def test_a_checkpoint_keeps_every_fruit_where_it_is(world: World) -> None:
    spot = first_red(world)
    line = grasp(world, spot)
    assert line is not None
    pull(world, spot, line)
    world.orchard.cut(next(one for one in world.orchard.spots if one.there and one.hangs))
    world.advance(1.0)
    kept = json.loads(json.dumps(world.snapshot()))
    told = tales(world)
    assert {where for _, where, *_ in told} == {"plant", "hand", "ground"}
    world.stride(2 * 3600.0)
    world.advance(1.0)
    wanted, qpos = tales(world), world.data.qpos.tolist()
    twin = World(world.scenario, world.seed)
    twin.restore(kept)
    assert tales(twin) == told
    twin.stride(2 * 3600.0)
    twin.advance(1.0)
    assert (tales(twin), twin.data.qpos.tolist()) == (wanted, qpos)


def quick(days: float) -> Scenario:
    """The garden with an ever wet soil."""
    garden = find("garden")
    return garden.model_copy(update={"climate": Climate(start_hour=10.0, litres_per_day=0.0, growth=days)})


def live(world: World, days: float) -> None:
    """Strides while at rest, steps while something falls."""
    until_s = world.time_s + days * DAY_S
    while world.time_s < until_s:
        if world.at_rest:
            world.stride(min(3600.0, until_s - world.time_s))
        else:
            world.advance(0.5)


@pytest.mark.parametrize("days", [3, pytest.param(10, marks=pytest.mark.soak)])
def test_days_of_growth_keep_who_is_who(days: int, quiet: Callable[[World], None]) -> None:
    world = World(quick(1.0), 11)
    first = {fruit.id: fruit for plant in world.truth().plants for fruit in plant.fruit}
    seen = dict(first)
    for _ in range(days):
        live(world, 1.0)
        truth = world.truth()
        now = {fruit.id: fruit for plant in truth.plants for fruit in plant.fruit}
        assert len(now) == sum(len(plant.fruit) for plant in truth.plants)
        gone = {gone.id for plant in truth.plants for gone in plant.gone}
        assert set(seen) <= set(now) | gone
        for fruit_id, fruit in now.items():
            before = seen.get(fruit_id)
            if before is not None:
                assert fruit.radius_m >= before.radius_m
                assert fruit.ripeness >= before.ripeness
                assert (fruit.where == "plant") or before.ripeness > RED_FROM
        seen |= now
    ripened = sum(fruit.colour == "red" and first[name].colour != "red" for name, fruit in seen.items() if name in first)
    dropped = sum(plant.dropped.red for plant in truth.plants)
    assert ripened >= days
    assert 0 <= dropped <= len(first)
    assert days < 10 or (len(seen) > len(first) and dropped)
    assert all(fruit.radius_m < 0.012 for name, fruit in seen.items() if name not in first)
    quiet(world)


def test_growth_can_be_hurried_and_a_thirsty_plants_fruit_stays_small() -> None:
    rng = np.random.default_rng(3)
    fed, dry = flower("a", 0.0, rng), flower("b", 0.0, rng)
    dry.full_radius_m, dry.green_days = fed.full_radius_m, fed.green_days
    for _ in range(30):
        fed.live(1.0, 0.0)
        dry.live(1.0, 0.5)
    assert dry.radius_m < 0.8 * fed.radius_m
    assert dry.ripeness == pytest.approx(fed.ripeness)
    slow, fast = World(quick(1.0), 5), World(quick(24.0), 5)
    live(slow, 1.0)
    live(fast, 1.0 / 24.0)
    ripe = [[round(fruit.ripeness, 2) for fruit in w.truth().plants[0].fruit] for w in (slow, fast)]
    assert np.allclose(ripe[0], ripe[1], atol=0.02)
    assert 0.0 < TURNING_FROM < RED_FROM < 1.0


@pytest.mark.soak
def test_twenty_grasps_and_more_over_seeds_end_in_the_basket() -> None:
    ends: Counter[str] = Counter()
    torn: Counter[str] = Counter()
    peaks = []
    for seed in range(1, 5):
        world = World(find("garden"), seed)
        for plant in world.scenario.plants:
            dock(world, plant.id)
            for spot in reds(world, plant.id):
                line = grasp(world, spot) if spot.hangs else None
                if line is None:
                    ends["torn before" if not spot.hangs else "out of reach"] += 1
                    continue
                peaks.append(pull(world, spot, line))
                lay_into_basket(world, line)
                ends[world.orchard.where(spot)[0]] += 1
        truth = world.truth().robot(ROBOT)
        torn.update({f"{how} {k}": v for how, by in (("grip", truth.torn_gripped), ("touch", truth.torn_touched))
                     for k, v in by.model_dump().items()})  # fmt: skip
    tried = sum(ends.values()) - ends["out of reach"] - ends["torn before"]
    print(f"seeds 1-4: {dict(ends)}, torn {dict(torn)}, pull {min(peaks):.2f}-{max(peaks):.2f} N, of {tried} tried")
    assert tried >= 20
    assert ends["basket"] / tried >= 0.9
    assert NEAR_M > 0.2
