"""A scenario and a seed in; a compiled MuJoCo model out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco

from core.scenario import Scenario
from sim.scene import furniture
from sim.scene.gardener import SLAB, add_gardener
from sim.scene.tomato import Shrub, grow
from sim.scene.traits import Traits, generator, traits_of

DT_S = 0.004
IMPRATIO = 10.0

TYRE_FRICTION = 0.9
"""Rubber on astroturf."""
FRONT_CASTER_FRICTION = 0.10
REAR_CASTER_FRICTION = 0.55
"""Sideways, on astroturf; along its own direction the rear caster rolls."""
TYRE_SOLREF = (0.01, 1.0)
TYRE_SOLIMP = (0.4, 0.4, 0.001, 0.5, 2.0)
"""A soft tyre. So low an impedance lets the friction rows creep by their regularisation and not by a slow damping, which
would give slip a memory of half a second (`sim.physics.wheels`)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    model: Any
    """mujoco.MjModel"""
    shrubs: dict[str, Shrub]
    traits: dict[str, Traits]


def build(scenario: Scenario, seed: int) -> Scene:
    """Compiles the garden. The same scenario and seed give the same model."""
    shrubs = {p.id: grow(p.height_m, p.fruit, generator(seed, f"shrub/{p.id}")) for p in scenario.plants}
    traits = {robot.id: traits_of(robot.id, seed) for robot in scenario.robots}
    spec = mujoco.MjSpec()
    spec.modelname = scenario.name
    spec.compiler.degree = False
    _options(spec)
    furniture.add_all(spec, scenario, shrubs)
    for robot in scenario.robots:
        add_gardener(spec, robot, traits[robot.id])
        _floor_contacts(spec, robot.id)
    return Scene(model=spec.compile(), shrubs=shrubs, traits=traits)


def _options(spec: Any) -> None:
    spec.option.timestep = DT_S
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = IMPRATIO
    spec.option.iterations = 20
    spec.option.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP
    for name, specular in (("turf", 0.05), ("soil", 0.02)):
        rgba = furniture.TURF_RGBA if name == "turf" else furniture.SOIL_RGBA
        spec.add_material(name=name, rgba=list(rgba), specular=specular)


def _floor_contacts(spec: Any, robot_id: str) -> None:
    for part, mu in (
        ("left-tread", TYRE_FRICTION),
        ("right-tread", TYRE_FRICTION),
        ("rear-caster", REAR_CASTER_FRICTION),
        ("front-caster", FRONT_CASTER_FRICTION),
    ):
        pair = spec.add_pair(name=f"{robot_id}/{part}", geomname1=f"{robot_id}/{part}", geomname2=SLAB)
        pair.condim = 3
        pair.friction = [mu, mu, 0.005, 0.0001, 0.0001]
        pair.solref, pair.solimp = list(TYRE_SOLREF), list(TYRE_SOLIMP)
