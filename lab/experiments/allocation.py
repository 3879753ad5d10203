"""Giving tasks away (paper 000, section 7 and figure 13): the figure's trace, and costs beside an optimum.

Whole markets run to their end in `lab.crowd`, by the plants' and robots' own machines. Beside each stands the best that
OR-tools finds for the same instance with all of it known at once, once for the least total of seconds that robots are
busy and once for the soonest end; it begins at our own solution, so that it is never worse.
"""

from __future__ import annotations

from collections.abc import Callable
from random import Random
from statistics import mean
from typing import Any

from core.allocation.bidding import price
from core.allocation.plant_side import Market
from core.allocation.plant_state import Effect, Grant, Kill, Solicit
from core.errors import ConfigError
from core.wire.geometry import Point3, Pose2
from core.wire.market import Bid, PlantCard, Report
from lab.crowd import Crowd, Instance, Price
from lab.results import Result, held

SIZES = ((2, 4), (2, 10), (5, 30), (10, 100))
"""Robots and plants."""
TRIALS = 3
"""Instances of each size."""
SEARCH_S = {4: 1, 10: 2, 30: 8, 100: 30}
"""What OR-tools is given for each of its two searches, by plants [s]."""
PAPER = {"fig13_ok": "robot 1 bids 3, then 7; robot 2 bids 4: kill, award"}
PROMISES = (("fig13_ok", ">=", 1), ("total_cost_ratio", "<=", 1.10), ("makespan_ratio", "<=", 1.25))
TENTHS = 10
"""OR-tools counts in whole numbers: tenths of a second."""


def allocation(trials: int | None, seed: int, swap: Price | None, progress: Callable[[str], None]) -> Result:
    """`trials` instances of each size; `swap` is another price: (Announcement, Condition) -> Bid."""
    count = trials or TRIALS
    ours: dict[str, Any] = {"fig13_ok": int(fig13() == FIG13)}
    worst_total, worst_span = 0.0, 0.0
    for robots, plants in SIZES:
        totals, spans = [], []
        for trial in range(count):
            instance = Instance.drawn(robots, plants, Random(f"{seed + trial}/{robots}/{plants}"))
            total_ratio, span_ratio = compared(instance, seed + trial, swap or price)
            totals.append(total_ratio)
            spans.append(span_ratio)
            progress(f"{robots} x {plants}, seed {seed + trial}: total {total_ratio:.3f}, makespan {span_ratio:.3f}")
        ours[f"total_cost_ratio_{robots}x{plants}"], ours[f"makespan_ratio_{robots}x{plants}"] = mean(totals), mean(spans)
        worst_total, worst_span = max(worst_total, mean(totals)), max(worst_span, mean(spans))
    ours |= {"total_cost_ratio": worst_total, "makespan_ratio": worst_span}
    return Result(
        name="allocation", seed=seed, trials=count, paper=PAPER, ours=ours, bars=held(ours, *PROMISES),
        notes=("ratios are means over a size's instances; without a size, the worst size's",),
    )  # fmt: skip


def compared(instance: Instance, seed: int, bid: Price) -> tuple[float, float]:
    """Our total and our end over the best that OR-tools finds."""
    outcome = Crowd(instance, Random(f"{seed}/words"), bid).run()
    least_s, soonest_s = best_found(instance, outcome.routes)
    return sum(outcome.busy_s) / least_s, outcome.makespan_s / soonest_s


def best_found(instance: Instance, ours: list[list[int]]) -> tuple[float, float]:
    """The least sum of all routes, and the least longest route [s], that OR-tools finds from ours on."""
    return _searched(instance, ours, even=False), _searched(instance, ours, even=True)


def _searched(instance: Instance, ours: list[list[int]], *, even: bool) -> float:
    try:
        from ortools.constraint_solver import pywrapcp, routing_enums_pb2
    except ImportError as error:
        raise ConfigError("the optimum needs OR-tools", hint="pip install 'robot-garden[bench]'") from error
    plants, robots = len(instance.plants), len(instance.starts)
    end = plants + robots
    manager = pywrapcp.RoutingIndexManager(end + 1, robots, [plants + r for r in range(robots)], [end] * robots)
    model = pywrapcp.RoutingModel(manager)

    def leg(a: int, b: int) -> int:
        here, there = manager.IndexToNode(a), manager.IndexToNode(b)
        if here == end or there >= plants:
            return 0
        docked = here < plants
        before = instance.plants[here] if docked else instance.starts[here - plants]
        return round(TENTHS * instance.leg_s(before, docked, there))

    cost = model.RegisterTransitCallback(leg)
    model.SetArcCostEvaluatorOfAllVehicles(cost)
    if even:
        model.AddDimension(cost, 0, 10**9, True, "seconds")
        model.GetDimensionOrDie("seconds").SetGlobalSpanCostCoefficient(1000)
    asked = pywrapcp.DefaultRoutingSearchParameters()
    asked.local_search_metaheuristic = routing_enums_pb2.LocalSearchMetaheuristic.GUIDED_LOCAL_SEARCH
    asked.time_limit.seconds = min(s for size, s in SEARCH_S.items() if size >= plants)
    model.CloseModelWithParameters(asked)
    first = model.ReadAssignmentFromRoutes(ours, True)
    found = model.SolveFromAssignmentWithParameters(first, asked)
    lengths = [_length(instance, model, manager, found, robot) for robot in range(robots)]
    return max(lengths) if even else sum(lengths)


def _length(instance: Instance, model: Any, manager: Any, found: Any, robot: int) -> float:
    plants, index = [], found.Value(model.NextVar(model.Start(robot)))
    while not model.IsEnd(index):
        plants.append(manager.IndexToNode(index))
        index = found.Value(model.NextVar(index))
    return instance.route_s(robot, plants)


# ------------------------------------------------------------------------------------------------- figure 13

FIG13 = [
    "ask robot-1 robot-2", "award robot-1 at 3, epoch 1", "ask robot-1 robot-2", "kill robot-1, epoch 1",
    "award robot-2 at 4, epoch 2",
]  # fmt: skip


def fig13() -> list[str]:
    """What plant 1 does while robot 1 says 3 and later 7, and robot 2 says 4 each time."""
    origin = Point3(x_m=0.0, y_m=0.0, z_m=0.0)
    dock = Pose2(x_m=0.0, y_m=0.0, yaw_rad=0.0)
    plant = Market(PlantCard(plant_id="plant-1", url="http://plant-1", stem=origin, dock=dock, nozzle=origin), None, 0.0)
    plant.soil(0.1, "", 0.0)
    task_id = plant.ask("water", 150.0, "soil", "dry", 0.0).task_id
    told: list[str] = []
    for at_s, first_s in ((0.0, 3.0), (plant.rules.reallocate_s + 1.0, 7.0)):
        if at_s:
            plant.report(task_id, Report(robot_id="robot-1", epoch=1, state="awarded"), at_s)
        plant.tick(at_s, ("robot-1", "robot-2"))
        for effect in plant.take_effects():
            told += _said(effect)
            if isinstance(effect, Solicit):
                for robot_id, cost_s in (("robot-1", first_s), ("robot-2", 4.0)):
                    bid = Bid(task_id=task_id, robot_id=robot_id, cost_s=cost_s)
                    plant.bid(task_id, effect.round_number, robot_id, bid, at_s)
        told += [line for effect in plant.take_effects() for line in _said(effect)]
    return told


def _said(effect: Effect) -> list[str]:
    match effect:
        case Solicit():
            return [f"ask {' '.join(effect.robots)}"]
        case Grant():
            return [f"award {effect.robot_id} at {effect.award.cost_s:g}, epoch {effect.award.epoch}"]
        case Kill():
            return [f"kill {effect.robot_id}, epoch {effect.epoch}"]
    return []
