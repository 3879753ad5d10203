"""A world's changing state as plain JSON, and back."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from core.errors import ConfigError
from sim.body import RobotFaults
from sim.physics.touch import Tally
from sim.physics.water import PumpFault
from sim.pot import ProbeFault

if TYPE_CHECKING:
    from sim.body import RobotBody
    from sim.pot import Pot
    from sim.world import World

VERSION = 2
PHYSICS = mujoco.mjtState.mjSTATE_INTEGRATION


def taken(world: World) -> dict[str, Any]:
    """The whole changing state of `world`."""
    state = np.empty(mujoco.mj_stateSize(world.model, PHYSICS))
    mujoco.mj_getState(world.model, world.data, state, PHYSICS)
    return {
        "version": VERSION,
        "scenario": world.scenario.name,
        "seed": world.seed,
        "time_s": world.time_s,
        "spilt_ml": world.spilt_ml,
        "tap_ml": world.tap_ml,
        "taps": sorted(world.tap_board.open),
        "physics": state.tolist(),
        "asleep": world.data.tree_asleep.tolist(),
        "orchard": world.orchard.kept(),
        "robots": {name: _robot(robot) | {"tally": asdict(world.touch.tally[name])} for name, robot in world.robots.items()},
        "pots": {name: _pot(pot) for name, pot in world.pots.items()},
    }


def put_back(world: World, snapshot: dict[str, Any]) -> None:
    """Overwrites `world` with a snapshot; raises ConfigError when it is of another world."""
    size = mujoco.mj_stateSize(world.model, PHYSICS)
    same = (snapshot.get("version"), snapshot.get("scenario"), snapshot.get("seed")) == (
        VERSION,
        world.scenario.name,
        world.seed,
    )
    if not same or len(snapshot["physics"]) != size or set(snapshot["pots"]) != set(world.pots):
        raise ConfigError("the checkpoint is of another world", hint="remove it, or start with its scenario and seed")
    world.orchard.put_back(snapshot["orchard"])
    _put_physics(world, snapshot)
    world.time_s, world.spilt_ml, world.tap_ml = (float(snapshot[k]) for k in ("time_s", "spilt_ml", "tap_ml"))
    world.tap_board.open = set(snapshot["taps"])
    world.touch.forget()
    for name, robot in world.robots.items():
        _put_robot(robot, snapshot["robots"][name])
        world.touch.tally[name] = Tally(**snapshot["robots"][name]["tally"])
    for name, pot in world.pots.items():
        _put_pot(pot, snapshot["pots"][name])


def _put_physics(world: World, snapshot: dict[str, Any]) -> None:
    """The state alone would leave sleepers where they lie, or wake them: all are woken, then laid down as they were.

    MuJoCo lays down at the end of a step only, so one step is done with everything awake but those about to fall asleep;
    then the state is put in place once more.
    """
    model, data = world.model, world.data
    state, asleep = np.array(snapshot["physics"]), np.array(snapshot["asleep"], dtype=np.int32)
    mujoco.mj_setState(model, data, state, PHYSICS)
    model.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    mujoco.mj_forward(model, data)
    model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    data.tree_asleep[:] = np.where(asleep >= 0, -1, -100)
    mujoco.mj_step(model, data)
    mujoco.mj_setState(model, data, state, PHYSICS)
    data.tree_asleep[:] = asleep


def _robot(robot: RobotBody) -> dict[str, Any]:
    return {
        "wanted_mps": robot.drive.wanted_mps,
        "ramped_mps": robot.drive.ramped_mps,
        "target_rad": robot.arm.target_rad,
        "now_rad": robot.arm.now_rad,
        "charge_ah": robot.pack.charge_ah,
        "tank_ml": robot.tank.level_ml,
        "pump_on": robot.tank.switched_on,
        "pumped_ml": robot.pumped_ml,
        "stuck_v": robot.stuck_v,
        "faults": asdict(robot.faults) | {"pump": robot.faults.pump.value, "camera": sorted(robot.faults.camera)},
        "marker_rng": robot.marker_rng.bit_generator.state,
        "analog_rng": robot.analog_rng.bit_generator.state,
    }


def _put_robot(robot: RobotBody, kept: dict[str, Any]) -> None:
    robot.drive.wanted_mps, robot.drive.ramped_mps = list(kept["wanted_mps"]), list(kept["ramped_mps"])
    robot.arm.target_rad, robot.arm.now_rad = dict(kept["target_rad"]), dict(kept["now_rad"])
    robot.pack.charge_ah = kept["charge_ah"]
    robot.tank.level_ml, robot.tank.switched_on = kept["tank_ml"], kept["pump_on"]
    robot.pumped_ml = kept["pumped_ml"]
    faults = kept["faults"]
    robot.faults = RobotFaults(**(faults | {"pump": PumpFault(faults["pump"]), "camera": frozenset(faults["camera"])}))
    robot.stuck_v = kept["stuck_v"]
    robot.marker_rng.bit_generator.state = kept["marker_rng"]
    robot.analog_rng.bit_generator.state = kept["analog_rng"]


def _pot(pot: Pot) -> dict[str, Any]:
    return {
        "soil": asdict(pot.soil),
        "probe_fault": pot.probe_fault.value,
        "stuck_v": pot.stuck_v,
        "rng": pot.rng.bit_generator.state,
    }


def _put_pot(pot: Pot, kept: dict[str, Any]) -> None:
    pot.soil = type(pot.soil)(**kept["soil"])
    pot.probe_fault = ProbeFault(kept["probe_fault"])
    pot.stuck_v = kept["stuck_v"]
    pot.rng.bit_generator.state = kept["rng"]
