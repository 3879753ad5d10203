"""Tables on a terminal of 80 columns: names and counts whole."""

from __future__ import annotations

from io import StringIO

from rich.console import Console

from console.tables import plants, tasks
from core.wire.fruit import FruitCounts
from core.wire.geometry import Point3, Pose2
from core.wire.market import PlantCard, Task
from core.wire.plant import PlantState, Settings, SoilReading


def pot(number: int) -> PlantState:
    point, name = Point3(x_m=0.0, y_m=0.0, z_m=0.0), f"plant-{number}"
    card = PlantCard(plant_id=name, url="http://x", stem=point, dock=Pose2(x_m=0.0, y_m=0.0, yaw_rad=0.0), nozzle=point)
    why = "nobody can take plant-2:1:13: robot-1: stopped by operator; robot-2: did not answer"
    return PlantState(
        plant_id=name, now_s=0.0, soil=SoilReading(state="good", ratio=0.199, why=""), thirsty=True, settings=Settings(),
        open_tasks=["plant-1:1:12", "plant-1:1:13"], watered_today_ml=300.0, dock_holder="robot-1",
        fruit=FruitCounts(green=12, turning=3, red=2), waiting=why, card=card,
    )  # fmt: skip


def test_names_and_counts_of_fruit_are_whole_on_eighty_columns() -> None:
    out = StringIO()
    Console(file=out, width=80).print(plants([pot(1), pot(2)]))
    told = out.getvalue()
    print(told)
    assert all(word in told for word in ("plant-1", "plant-2", "green", "turning", "red"))
    assert max(map(len, told.splitlines())) <= 80


def test_a_tasks_id_is_whole_on_eighty_columns() -> None:
    why = "2 ripe fruit to pick, asked for by an order that came from the console at noon"
    task = Task(
        task_id="plant-12:104:1017", kind="inventory", state="announced", plant_id="plant-12", robot_id="robot-1",
        created_s=0.0, updated_s=0.0, why=why, phase="navigate: waits for dock plant-12",
    )  # fmt: skip
    out = StringIO()
    Console(file=out, width=80).print(tasks([task]))
    told = out.getvalue()
    print(told)
    assert all(word in told for word in ("plant-12:104:1017", "announced"))
    assert max(map(len, told.splitlines())) <= 80
