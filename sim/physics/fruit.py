"""Fruit on stalks: hanging, grown from time to time, gripped by friction alone, torn off by force, falling, lying.

A stalk is a spring that only pulls. Its pull is read after every step of the physics while a hand is near; when it exceeds
what the joint bears at that ripeness (`sim.growth`), the spring is gone. A joint minds being bent and twisted more than
being pulled: along the fruit's axis it bears its full strength, bent by 90 degrees or twisted by 180 half of it. Sources: by
the angle of the pull, ripe cherry tomatoes came off at 0.58 to 2.46 N (Xie et al., Agriculture 2021, 11, 815); bending parts
tomatoes at the joint better than pulling (tcsae.org/article/id/20081214); twisting needs a large angle (Gao et al. 2022,
"Dynamic analysis of picking patterns for robotic harvesting of cherry tomatoes").
Everything else is MuJoCo's: fruit sleep while nobody touches them and wake by contact.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import numpy as np

from core.robots.gardener import BASKET_HALF_M, BASKET_M
from core.scenario import Scenario
from sim.growth import AGAIN_DAYS, RADIUS_MAX_M, Growing, flower, truss_ages
from sim.scene.collide import ARM, FRUIT
from sim.scene.hang import BUD_M, STALK_DAMPING, STALK_NPM, fruit_name
from sim.scene.tomato import STEM_RGBA, TURNING_FROM, Colour, Shrub, rgba_of
from sim.scene.traits import generator

Where = Literal["plant", "hand", "basket", "ground"]
How = Literal["grip", "touch"]
"""Both pads held it when it came off, or it was brushed, dragged or struck."""
DAMPING_LINEAR, DAMPING_ANGULAR = 0.01, 2e-6
"""Of a fruit in the air [N s/m, N m s/rad]: else it would swing for ever."""
KG_MIN = 0.009
"""A small green fruit is as heavy as this to the physics: a lighter one on so stiff a spring would outrun the step."""
BENT_LOSS, BENT_RAD, TWIST_RAD = 0.5, math.pi / 2, math.pi
GROW_S = 3600.0
"""Fruit get their new size and colour this often."""
STEP_M, STEP_RIPENESS = 1e-5, 0.003
"""Changes of radius and of ripeness below these are not drawn yet."""
ROT_DAYS = 3.0
"""What has lain on the ground for so long is gone."""
NUDGE_MPS = 0.005
"""Given to a fruit whose stalk is cut: MuJoCo wakes it, and the world is no longer at rest."""
WAKE_MPS = 1e-4
NEAR_M = 0.45
"""A hand this near to a stem is watched; fruit hangs within 0.2 m of it."""
ASTRAY_M = 0.002
"""A fruit further than this from where it would hang is being moved: growth leaves its place to the physics."""
SWAY_HZ = 0.4
GONE_MAX = 200
DAY_S = 86400.0


@dataclass(slots=True, kw_only=True)
class Gone:
    """A fruit that is no more in the garden: taken out of a basket, or rotten on the ground."""

    fruit_id: str
    plant_id: str
    how: Literal["taken", "rotten"]
    robot_id: str | None
    colour: Colour
    at_s: float


@dataclass(slots=True, kw_only=True)
class Spot:
    """A place on a plant and the body that belongs to it; ids and addresses are MuJoCo's."""

    plant_id: str
    truss: int
    knuckle: int
    body: int
    ball: int
    stub: int
    top: int
    tendon: int
    qpos: int
    dof: int
    stalk_m: float
    growing: Growing
    hangs: bool = True
    """The stalk holds."""
    drawn_m: float = 0.0
    """Radius as the model has it; 0: nothing to be seen yet."""
    drawn_ripeness: float = 0.0
    torn_by: str | None = None
    torn_how: How | None = None
    lies_days: float = 0.0

    @property
    def there(self) -> bool:
        """Whether there is a fruit, not just a flower."""
        return self.drawn_m > 0.0


@dataclass(slots=True)
class _Swaying:
    """A truss and the way in which it gives."""

    plant_id: str
    index: int
    mocap: int
    home_m: Any
    angle_rad: float
    phase_rad: float
    swung: bool = False


@dataclass(slots=True)
class Tally:
    """How many fruit came off, by colour."""

    green: int = 0
    turning: int = 0
    red: int = 0

    def count(self, colour: Colour) -> None:
        setattr(self, colour, getattr(self, colour) + 1)


@dataclass(slots=True)
class Torn:
    """By one robot: `grip` held between its pads, `touch` otherwise."""

    grip: Tally = field(default_factory=Tally)
    touch: Tally = field(default_factory=Tally)


class Orchard:
    """All fruit of a garden. `World` steps it; nothing but `World.restore` may move a fruit that does not hang."""

    def __init__(self, scenario: Scenario, seed: int, model: Any, data: Any, shrubs: Mapping[str, Shrub]) -> None:
        self._model, self._data = model, data
        self.days_a_second = scenario.climate.growth / DAY_S
        self.torn = {robot.id: Torn() for robot in scenario.robots}
        self.fallen = {plant_id: Tally() for plant_id in shrubs}
        """Dropped overripe, or shaken off with no robot near."""
        self.gone: list[Gone] = []
        self.rng = {plant_id: generator(seed, f"growth/{plant_id}") for plant_id in shrubs}
        self.named = dict.fromkeys(shrubs, 0)
        self.grown_s = 0.0
        self.sway_m = dict.fromkeys(shrubs, 0.0)
        """How far something pushes a plant's trusses to and fro."""
        self._trusses = list(self._mocaps(shrubs, seed))
        self.spots = [spot for plant_id, shrub in shrubs.items() for spot in self._spots(plant_id, shrub)]
        self._stems = [(plant.x_m, plant.y_m) for plant in scenario.plants]
        self._hands = {r.id: int(model.site(f"{r.id}/tool").id) for r in scenario.robots}
        self._bases = {r.id: int(model.body(r.id).id) for r in scenario.robots}
        self._parts = _parts(model, self._bases)
        self._by_tendon = {spot.tendon: spot for spot in self.spots}
        self._least_m = np.full(model.ntendon, np.inf)
        """By tendon: a stalk shorter than this does not break, however bent; infinite where nothing hangs."""
        for spot in self.spots:
            model.dof_damping[spot.dof : spot.dof + 3] = DAMPING_LINEAR
            model.dof_damping[spot.dof + 3 : spot.dof + 6] = DAMPING_ANGULAR
            self._draw(spot)
            self._hang(spot)
        self._know()

    def _mocaps(self, shrubs: Mapping[str, Shrub], seed: int) -> Iterator[_Swaying]:
        for plant_id, shrub in shrubs.items():
            rng = generator(seed, f"sway/{plant_id}")
            for index in range(len(shrub.trusses)):
                mocap = int(self._model.body(f"{plant_id}/truss/{index}").mocapid[0])
                angle_rad, phase_rad = rng.uniform(0.0, math.tau, 2)
                yield _Swaying(
                    plant_id, index, mocap, self._data.mocap_pos[mocap].copy(), float(angle_rad), float(phase_rad)
                )

    def _spots(self, plant_id: str, shrub: Shrub) -> Iterator[Spot]:
        rng = self.rng[plant_id]
        ages = truss_ages([(len(truss.places), truss.flowering) for truss in shrub.trusses], rng)
        number = 0
        for index, truss in enumerate(shrub.trusses):
            for place, age_days in zip(truss.places, ages[index], strict=True):
                name = fruit_name(plant_id, number)
                joint = self._model.joint(name)
                yield Spot(
                    plant_id=plant_id,
                    truss=index,
                    knuckle=int(self._model.site(f"{name}/knuckle").id),
                    body=int(self._model.body(name).id),
                    ball=int(self._model.geom(name).id),
                    stub=int(self._model.geom(f"{name}/stub").id),
                    top=int(self._model.site(f"{name}/top").id),
                    tendon=int(self._model.tendon(f"{name}/stalk").id),
                    qpos=int(joint.qposadr[0]),
                    dof=int(joint.dofadr[0]),
                    stalk_m=place.stalk_m,
                    growing=flower(self._name(plant_id), age_days, rng),
                )
                number += 1

    def _name(self, plant_id: str) -> str:
        self.named[plant_id] += 1
        return f"{plant_id}-f{self.named[plant_id]}"

    # What a fruit is to MuJoCo

    def _draw(self, spot: Spot) -> None:
        """Size, weight and colour of a fruit, or of the bud that stands for one."""
        model, growing = self._model, spot.growing
        spot.drawn_m = growing.radius_m if growing.set else 0.0
        r_m = spot.drawn_m or BUD_M
        kg = max(KG_MIN, growing.mass_kg if spot.there else 0.0)
        inertia = 0.4 * kg * max(r_m, RADIUS_MAX_M / 2) ** 2
        model.geom_size[spot.ball, 0] = model.geom_rbound[spot.ball] = r_m
        model.geom_aabb[spot.ball, 3:] = r_m
        model.body_mass[spot.body] = model.body_subtreemass[spot.body] = kg
        model.body_inertia[spot.body] = inertia
        model.body_invweight0[spot.body] = (1.0 / kg, 1.0 / inertia)
        model.dof_invweight0[spot.dof : spot.dof + 3] = 1.0 / kg
        model.dof_invweight0[spot.dof + 3 : spot.dof + 6] = 1.0 / inertia
        model.site_pos[spot.top, 2] = r_m
        model.geom_pos[spot.stub, 2] = r_m + spot.stalk_m / 2
        model.geom_contype[spot.ball] = FRUIT if spot.there else 0
        model.geom_conaffinity[spot.ball] = ARM | FRUIT if spot.there else 0
        self._tint(spot)

    def _tint(self, spot: Spot) -> None:
        spot.drawn_ripeness = spot.growing.ripeness
        alpha = 1.0 if spot.there else 0.0
        self._model.geom_rgba[spot.ball] = (*rgba_of(spot.growing.ripeness)[:3], alpha)
        self._model.geom_rgba[spot.stub] = (*STEM_RGBA[:3], alpha)

    def _tie(self, spot: Spot, holds: bool) -> None:
        spot.hangs = holds
        self._model.tendon_stiffness[spot.tendon] = STALK_NPM if holds else 0.0
        self._model.tendon_damping[spot.tendon] = STALK_DAMPING if holds else 0.0

    def _rest_m(self, spot: Spot) -> Any:
        """Centre of the fruit as it hangs at rest."""
        kg = self._model.body_mass[spot.body]
        drop_m = spot.stalk_m + kg * 9.81 / STALK_NPM + self._model.site_pos[spot.top, 2]
        return self._data.site_xpos[spot.knuckle] - (0.0, 0.0, drop_m)

    def _hang(self, spot: Spot) -> None:
        self._tie(spot, True)
        self._data.qpos[spot.qpos : spot.qpos + 3] = self._rest_m(spot)
        self._data.qpos[spot.qpos + 3 : spot.qpos + 7] = (1.0, 0.0, 0.0, 0.0)
        self._data.qvel[spot.dof : spot.dof + 6] = 0.0

    def _know(self) -> None:
        for spot in self.spots:
            least_n = spot.growing.strength_n * (1.0 - BENT_LOSS) if spot.hangs and spot.there else math.inf
            self._least_m[spot.tendon] = spot.stalk_m + least_n / STALK_NPM

    # Being pushed

    @property
    def swaying(self) -> bool:
        return any(self.sway_m.values()) or any(truss.swung for truss in self._trusses)

    def sway(self, now_s: float) -> None:
        """Trusses go where they are pushed now; back to their places once nothing pushes them."""
        for truss in self._trusses:
            far_m = self.sway_m[truss.plant_id]
            if not far_m and not truss.swung:
                continue
            out_m = far_m * math.sin(math.tau * SWAY_HZ * now_s + truss.phase_rad)
            push_m = (out_m * math.cos(truss.angle_rad), out_m * math.sin(truss.angle_rad), 0.0)
            self._data.mocap_pos[truss.mocap] = truss.home_m + push_m
            truss.swung = far_m > 0.0
            for spot in self.spots:
                if spot.hangs and (spot.plant_id, spot.truss) == (truss.plant_id, truss.index):
                    self._data.qvel[spot.dof + 2] -= WAKE_MPS

    # Force

    def near(self) -> bool:
        """Whether a hand is near a plant, so that `watch` is wanted after every step."""
        for site in self._hands.values():
            x_m, y_m, _ = self._data.site_xpos[site].tolist()
            for stem_x_m, stem_y_m in self._stems:
                if abs(x_m - stem_x_m) < NEAR_M and abs(y_m - stem_y_m) < NEAR_M:
                    return True
        return False

    def watch(self) -> bool:
        """Lets stalks break that are pulled too hard; whether one did."""
        # A sleeping tendon has no length; nothing pulls at it either.
        long = self._data.ten_length > self._least_m
        if not np.count_nonzero(long):
            return False
        broke = False
        for tendon in long.nonzero()[0].tolist():
            spot = self._by_tendon[tendon]
            if STALK_NPM * (float(self._data.ten_length[tendon]) - spot.stalk_m) > self.strength_n(spot):
                self.cut(spot, *self._who(spot))
                broke = True
        return broke

    def pull_n(self, spot: Spot) -> float:
        """What its stalk bears now."""
        if not spot.hangs:
            return 0.0
        return max(
            0.0, STALK_NPM * (math.dist(self._data.site_xpos[spot.knuckle], self._data.site_xpos[spot.top]) - spot.stalk_m)
        )

    def strength_n(self, spot: Spot) -> float:
        """Pull that would break its joint as it is bent and twisted now."""
        data = self._data
        stalk = data.site_xpos[spot.knuckle] - data.site_xpos[spot.top]
        axis = data.xmat[spot.body].reshape(3, 3)[:, 2]
        cos = float(stalk @ axis) / max(float(np.linalg.norm(stalk)), 1e-6)
        bent_rad = math.acos(max(-1.0, min(1.0, cos)))
        w, _, _, z = data.xquat[spot.body].tolist()
        twist_rad = abs(2.0 * math.atan2(z, w))
        twist_rad = min(twist_rad, math.tau - twist_rad)
        share = min(1.0, bent_rad / BENT_RAD + twist_rad / TWIST_RAD)
        return spot.growing.strength_n * (1.0 - BENT_LOSS * share)

    def cut(self, spot: Spot, robot_id: str | None = None, how: How | None = None) -> None:
        """The stalk is gone."""
        self._tie(spot, False)
        spot.torn_by, spot.torn_how = robot_id, how
        spot.lies_days = 0.0
        self._least_m[spot.tendon] = math.inf
        if robot_id is None:
            self.fallen[spot.plant_id].count(spot.growing.colour)
        else:
            tally = self.torn[robot_id].grip if how == "grip" else self.torn[robot_id].touch
            tally.count(spot.growing.colour)
        self._data.qvel[spot.dof + 2] -= NUDGE_MPS

    def _who(self, spot: Spot) -> tuple[str | None, How | None]:
        """Whose doing it is that a stalk breaks now."""
        held = self._held(spot)
        if held is not None:
            return held, "grip"
        x, y, z = self._data.xpos[spot.body].tolist()
        reach = {name: math.dist((x, y, z), self._data.site_xpos[site]) for name, site in self._hands.items()}
        nearest = min(reach, key=lambda name: reach[name], default=None)
        return (nearest, "touch") if nearest is not None and reach[nearest] < NEAR_M else (None, None)

    def _touched(self, spot: Spot) -> Iterator[tuple[str, str]]:
        """(robot, part) of all that the fruit touches now."""
        if not self._data.ncon:
            return
        pairs = self._data.contact.geom
        for a, b in pairs[(pairs == spot.ball).any(axis=1)].tolist():
            part = self._parts.get(b if a == spot.ball else a)
            if part is not None:
                yield part

    def _held(self, spot: Spot) -> str | None:
        """The robot between whose pads it is."""
        touched = set(self._touched(spot))
        return next((r for r, part in touched if part == "pad-left" and (r, "pad-right") in touched), None)

    # Where things are

    def where(self, spot: Spot) -> tuple[Where, str | None]:
        """Where a fruit is, and whose hand or basket that is."""
        if spot.hangs:
            return "plant", None
        held = self._held(spot)
        if held is not None:
            return "hand", held
        for robot_id, base in self._bases.items():
            offset = self._data.xpos[spot.body] - self._data.xpos[base]
            p_base = offset @ self._data.xmat[base].reshape(3, 3)
            if (np.abs(p_base - BASKET_M) <= BASKET_HALF_M).all():
                return "basket", robot_id
        return "ground", None

    def position_m(self, spot: Spot) -> tuple[float, float, float]:
        """Centre in the world."""
        x, y, z = self._data.xpos[spot.body].tolist()
        return x, y, z

    def spot(self, fruit_id: str) -> Spot:
        """Raises KeyError for a fruit that is not in the garden."""
        for spot in self.spots:
            if spot.growing.fruit_id == fruit_id and spot.there:
                return spot
        raise KeyError(fruit_id)

    def balls(self) -> dict[str, int]:
        """Geom id of every fruit there is."""
        return {spot.growing.fruit_id: spot.ball for spot in self.spots if spot.there}

    # Time

    def due(self, now_s: float) -> bool:
        """Whether it is time to `grow`."""
        return self.grown_s + GROW_S <= now_s + 1e-6

    def grow(self, now_s: float, thirst: Mapping[str, float]) -> None:
        """Growth up to `now_s`, in steps of `GROW_S`; `thirst` by plant. Positions want looking through afterwards."""
        while self.due(now_s):
            self.grown_s += GROW_S
            days = GROW_S * self.days_a_second
            for spot in self.spots:
                self._grow(spot, days, thirst[spot.plant_id])
        self._know()

    def _grow(self, spot: Spot, days: float, thirst: float) -> None:
        if not spot.hangs:
            self._lie(spot, days)
            return
        spot.growing.live(days, thirst)
        if not spot.growing.set:
            return
        if spot.growing.radius_m - spot.drawn_m > STEP_M:
            before = self._rest_m(spot)
            at_rest = math.dist(self._data.qpos[spot.qpos : spot.qpos + 3], before) < ASTRAY_M
            self._draw(spot)
            if at_rest:
                self._hang(spot)
        ripeness = spot.growing.ripeness
        if ripeness > TURNING_FROM and ripeness - spot.drawn_ripeness > STEP_RIPENESS:
            self._tint(spot)
        if spot.growing.overripe:
            self.cut(spot)

    def _lie(self, spot: Spot, days: float) -> None:
        spot.lies_days = spot.lies_days + days if self.where(spot)[0] == "ground" else 0.0
        if spot.lies_days > ROT_DAYS:
            self._remove(spot, "rotten", None)

    def take(self, robot_id: str) -> list[str]:
        """Somebody empties a robot's basket; the fruit that were in it."""
        inside = [spot for spot in self.spots if self.where(spot) == ("basket", robot_id)]
        taken = [spot.growing.fruit_id for spot in inside]
        for spot in inside:
            self._remove(spot, "taken", robot_id)
        self._know()
        return taken

    def _remove(self, spot: Spot, how: Literal["taken", "rotten"], robot_id: str | None) -> None:
        """The fruit leaves the garden; its place will flower again."""
        growing, rng = spot.growing, self.rng[spot.plant_id]
        self.gone.append(
            Gone(fruit_id=growing.fruit_id, plant_id=spot.plant_id, how=how, robot_id=robot_id, colour=growing.colour,
                 at_s=self.grown_s)
        )  # fmt: skip
        del self.gone[:-GONE_MAX]
        spot.growing = flower(self._name(spot.plant_id), -float(rng.uniform(*AGAIN_DAYS)), rng)
        spot.torn_by = spot.torn_how = None
        spot.lies_days = 0.0
        self._draw(spot)
        self._hang(spot)

    # Keeping

    def kept(self) -> dict[str, Any]:
        return {
            "grown_s": self.grown_s,
            "sway_m": dict(self.sway_m),
            "swung": [truss.swung for truss in self._trusses],
            "named": dict(self.named),
            "rng": {name: rng.bit_generator.state for name, rng in self.rng.items()},
            "torn": {name: asdict(torn) for name, torn in self.torn.items()},
            "fallen": {name: asdict(tally) for name, tally in self.fallen.items()},
            "gone": [asdict(gone) for gone in self.gone],
            "spots": [
                {
                    "growing": asdict(spot.growing),
                    "hangs": spot.hangs,
                    "drawn_m": spot.drawn_m,
                    "torn_by": spot.torn_by,
                    "torn_how": spot.torn_how,
                    "lies_days": spot.lies_days,
                }
                for spot in self.spots
            ],
        }

    def put_back(self, kept: dict[str, Any]) -> None:
        """Sizes, colours and stalks as they were; where the bodies are is the physics' own state."""
        self.sway_m = dict(kept["sway_m"])
        for truss, swung in zip(self._trusses, kept["swung"], strict=True):
            truss.swung = swung
        self.grown_s, self.named = float(kept["grown_s"]), dict(kept["named"])
        for name, state in kept["rng"].items():
            self.rng[name].bit_generator.state = state
        self.torn = {
            name: Torn(grip=Tally(**torn["grip"]), touch=Tally(**torn["touch"])) for name, torn in kept["torn"].items()
        }
        self.fallen = {name: Tally(**tally) for name, tally in kept["fallen"].items()}
        self.gone = [Gone(**gone) for gone in kept["gone"]]
        for spot, was in zip(self.spots, kept["spots"], strict=True):
            self._put_spot(spot, was)
        self._know()

    def _put_spot(self, spot: Spot, was: dict[str, Any]) -> None:
        spot.growing = Growing(**was["growing"])
        self._draw(spot)
        self._tie(spot, was["hangs"])
        spot.torn_by, spot.torn_how, spot.lies_days = was["torn_by"], was["torn_how"], was["lies_days"]


def _parts(model: Any, robots: Iterable[str]) -> dict[int, tuple[str, str]]:
    """Geom -> (robot, part) for all that belongs to robots."""
    known = set(robots)
    names = ((index, model.geom(index).name.partition("/")) for index in range(model.ngeom))
    return {index: (head, tail) for index, (head, _, tail) in names if head in known}
