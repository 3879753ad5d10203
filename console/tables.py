"""How the garden looks on a terminal."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from console.snapshot import Silent, Snapshot
from console.story import Story
from core.wire.market import FINAL_STATES, Bid, BidRound, Task
from core.wire.order import Order
from core.wire.plant import PlantState, StationState
from core.wire.robot import RobotState

TASKS_SHOWN = 8


def picture(snapshot: Snapshot) -> RenderableType:
    """Everything `garden status` shows."""
    parts: list[RenderableType] = [plants(snapshot.plants), robots(snapshot.robots)]
    if snapshot.stations:
        parts.append(stations(snapshot.stations))
    parts.append(tasks(snapshot.tasks[:TASKS_SHOWN]))
    if snapshot.silent:
        parts.append(silent(snapshot.silent))
    return Group(*parts)


def _table(title: str, *headings: str) -> Table:
    table = Table(title=title, title_justify="left", expand=False)
    for heading in headings:
        table.add_column(heading)
    return table


def plants(states: Sequence[PlantState]) -> Table:
    table = _table("Pots", "pot", "soil", "green", "turning", "red", "asks", "today ml", "tasks", "dock", "waiting for")
    table.padding = (0, 1, 0, 0)
    for column in table.columns:
        # A narrow terminal folds what is long, never a pot's name or a count.
        column.no_wrap, column.overflow = column.header in ("pot", "green", "turning", "red"), "fold"
    for state in states:
        soil = state.soil
        wet = f"{soil.ratio:.3f}" if soil.ratio is not None else f"{soil.state}: {soil.why}"
        fruit = (str(state.fruit.green), str(state.fruit.turning), str(state.fruit.red))
        asks = "water" if state.thirsty else ""
        open_tasks = ", ".join(state.open_tasks)
        table.add_row(
            state.plant_id, wet, *fruit, asks, f"{state.watered_today_ml:.0f}", open_tasks, state.dock_holder, state.waiting
        )
    return table


def robots(states: Sequence[RobotState]) -> Table:
    table = _table("Robots", "robot", "at", "battery", "tank ml", "does", "task", "waiting for")
    for state in states:
        pose = state.pose
        where = "?" if pose is None else f"{pose.x_m:+.2f} {pose.y_m:+.2f}"
        where = f"dock of {state.docked_at}" if state.docked_at else where
        stop = f"STOPPED by {state.stopped_by} (stop {state.stop_number})"
        does = Text(stop, style="bold red") if state.stopped else Text(state.job or "idle")
        tank = "?" if state.tank_ml is None else f"{state.tank_ml:.0f}"
        task = state.queue[0].task_id if state.queue else ""
        waiting = "; ".join(part for part in (state.waiting, *(f"down: {device}" for device in state.down)) if part)
        table.add_row(state.robot_id, where, f"{state.battery_ratio:.0%}", tank, does, task, waiting)
    return table


def stations(states: Sequence[StationState]) -> Table:
    table = _table("Station", "dock", "held by", "wanted by", "tap")
    for state in states:
        for dock in state.docks:
            tap = ("open" if state.tap_open else "closed") if dock.tap else ""
            table.add_row(f"{state.station_id}/{dock.dock_id}", dock.holder, dock.wanted_by, tap)
    return table


def tasks(listed: Sequence[Task]) -> Table:
    table = _table("Tasks", "task", "kind", "state", "pot", "robot", "phase", "why")
    for column in table.columns:
        # An id must be whole to be asked for.
        column.no_wrap, column.overflow = column.header in ("task", "kind", "state"), "fold"
    for task in listed:
        phase = "" if task.state in FINAL_STATES else task.phase
        table.add_row(task.task_id, task.kind, task.state, task.plant_id, task.robot_id, phase, task.reason or task.why)
    return table


def silent(listed: Sequence[Silent]) -> Table:
    table = _table("No answer", "who", "why")
    for one in listed:
        table.add_row(one.id, one.why)
    return table


def story(told: Story) -> RenderableType:
    """One task from its first announcement to its end: who bid what, who won, and why."""
    task = told.task
    head = Text(f"{task.task_id}: {task.kind} for {task.plant_id}, {task.state}", style="bold")
    lines = [f"asked by {task.asked_by or '?'} at {task.created_s:.1f} s: {task.why}"]
    if task.deadline_s is not None:
        lines.append(f"to be begun by {task.deadline_s:.1f} s")
    if task.kind == "water":
        lines.append(f"dose {task.dose_ml:g} ml")
    if task.kind == "harvest":
        order_id = f", order {task.order_id}" if task.order_id else ""
        lines.append(f"{task.count} wanted of {', '.join(task.fruit_ids)}{order_id}")
        lines += [f"{pick.fruit_id} {pick.outcome}" + (f": {pick.reason}" if pick.reason else "") for pick in task.picks]
    if task.delivered_ml is not None:
        lines.append(f"delivered {task.delivered_ml:.1f} ml")
    if task.reason:
        lines.append(f"reason: {task.reason}")
    parts: list[RenderableType] = [head, *lines]
    parts += [auction(round_) for round_ in task.rounds]
    steps = _table("What happened", "at s", "who", "what")
    for step in told.steps:
        steps.add_row(f"{step.t_s:.1f}", step.who, step.what)
    return Group(*parts, steps)


def progress(order: Order) -> str:
    """One line: what has come, and what is under way."""
    busy = [part for part in order.parts if part.state not in FINAL_STATES]
    doing = "; ".join(f"{p.plant_id}: {p.robot_id or 'asking robots'} {p.phase or p.state}" for p in busy)
    return f"{order.delivered} of {order.count} picked; {doing}" if doing else f"{order.delivered} of {order.count} picked"


def order(ended: Order) -> RenderableType:
    """An order with its parts."""
    table = _table(
        f"Order {ended.order_id}: {ended.state}, {ended.delivered} of {ended.count} ripe fruit",
        "pot", "wanted", "picked", "by", "state", "task", "why",
    )  # fmt: skip
    for part in ended.parts:
        fruit = ", ".join(part.picked)
        table.add_row(part.plant_id, str(part.count), fruit, part.robot_id, part.state, part.task_id, part.reason)
    return Group(table, Text(ended.reason, style="yellow")) if ended.reason else table


def auction(round_: BidRound) -> Table:
    winner = round_.winner or "nobody"
    table = _table(
        f"At {round_.t_s:.1f} s (epoch {round_.epoch}): {winner} won. {round_.why}",
        "robot", "cost s", "current", "queue", "travel", "work", "charge", "refill", "others", "says",
    )  # fmt: skip
    for bid in sorted(round_.bids, key=_rank):
        parts = bid.breakdown
        cells = (parts.current_s, parts.queue_s, parts.travel_s, parts.work_s, parts.charge_s, parts.refill_s, parts.delay_s)
        cost = "no" if bid.cost_s is None else f"{bid.cost_s:.1f}"
        table.add_row(
            bid.robot_id, cost, *(f"{seconds:.1f}" if bid.cost_s is not None else "" for seconds in cells), bid.reason
        )
    return table


def _rank(bid: Bid) -> tuple[float, str]:
    return (float("inf") if bid.cost_s is None else bid.cost_s, bid.robot_id)
