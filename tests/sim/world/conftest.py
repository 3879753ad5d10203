"""Small worlds for the physics tests."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from core.robots import gardener as g
from core.scenario import Plant, Robot, Scenario, Station, StationDock
from sim.world import World

SEED = 7
TAP = StationDock(id="tap", x_m=-1.95, y_m=0.0, dock_yaw_deg=0.0, tap=True)
SPARE = StationDock(id="spare", x_m=1.95, y_m=0.0, dock_yaw_deg=180.0)


def plot(robots: int = 1) -> Scenario:
    """One pot in a corner, a tap, and room to drive."""
    homes = [(0.0, 0.0), (0.0, -1.2)]
    return Scenario(
        plants=(Plant(id="plant-1", x_m=1.0, y_m=1.1, dock_yaw_deg=180.0, moisture_ratio=0.15),),
        robots=tuple(Robot(id=f"robot-{i + 1}", x_m=x, y_m=y) for i, (x, y) in enumerate(homes[:robots])),
        station=Station(docks=(TAP, SPARE)),
    )


@pytest.fixture(scope="session")
def fresh() -> Callable[[World], World]:
    """Takes a shared world back to its beginning: cheaper than to build another."""
    starts: dict[int, dict[str, object]] = {}

    def begin(world: World) -> World:
        world.restore(starts.setdefault(id(world), world.snapshot()))
        return world

    return begin


@pytest.fixture(scope="session")
def _plot_world() -> World:
    return World(plot(), SEED)


@pytest.fixture(scope="session")
def _pair_world() -> World:
    return World(plot(robots=2), SEED)


@pytest.fixture
def world(_plot_world: World, fresh: Callable[[World], World]) -> World:
    """One robot in the middle of a nearly empty field, at its beginning."""
    return fresh(_plot_world)


@pytest.fixture
def pair(_pair_world: World, fresh: Callable[[World], World]) -> World:
    """The same with a second robot 1.2 m to the first one's right."""
    return fresh(_pair_world)


def watering_rad() -> dict[str, float]:
    """Arm angles that hold the nozzle at the pot's nozzle point, hand 30 degrees down; plane geometry."""
    pitch = math.radians(-30.0)
    x = g.DOCK_TO_STEM_M - g.NOZZLE_POINT_M[0] - g.SHOULDER_X_M
    z = g.SOIL_HEIGHT_M + g.NOZZLE_POINT_M[2] - g.SHOULDER_Z_M
    ox, _, oz = g.NOZZLE_IN_HAND_M
    x -= ox * math.cos(pitch) - oz * math.sin(pitch)
    z -= ox * math.sin(pitch) + oz * math.cos(pitch)
    upper, fore = g.UPPER_ARM_M, g.FOREARM_M
    elbow = -math.acos((x * x + z * z - upper * upper - fore * fore) / (2 * upper * fore))
    shoulder = math.atan2(z, x) - math.atan2(fore * math.sin(elbow), upper + fore * math.cos(elbow))
    return {"pan": 0.0, "shoulder": shoulder, "elbow": elbow, "wrist": pitch - shoulder - elbow}


@pytest.fixture
def reach_out() -> Callable[[World], None]:
    """Puts robot-1 at plant-1's dock with the nozzle over the soil."""

    def reach(world: World) -> None:
        dock = world.scenario.docks()["plant-1"]
        world.teleport("robot-1", dock.x_m, dock.y_m, dock.yaw_rad)
        for joint, angle in watering_rad().items():
            servo = g.SERVOS[joint]
            world.servo_rig("robot-1").set_pulse(servo.channel, servo.pulse_us(angle))
        world.advance(3.0)

    return reach


@pytest.fixture
def quiet() -> Callable[[World], None]:
    """Asserts that MuJoCo had nothing to complain of."""

    def check(world: World) -> None:
        assert [int(warning.number) for warning in world.data.warning] == [0] * len(world.data.warning)

    return check
