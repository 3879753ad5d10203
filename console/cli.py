"""The `garden` command. Every subcommand is loaded when it is used, so that help and small questions are quick."""

from __future__ import annotations

import importlib
import sys
from importlib.metadata import entry_points
from pathlib import Path
from typing import Annotated, Any

import typer

from core.errors import GardenError

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="A garden that tends itself. The operator's side: start it, watch it, ask it, stop it.",
)
GROUP = "garden.commands"
"""Entry points of other folders: `garden reproduce`, `garden bench`, `garden emulate`."""

Data = Annotated[Path, typer.Option("--data", envvar="GARDEN_DATA", help="The garden's data folder")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON")]
Tls = Annotated[
    bool, typer.Option("--tls", help="HTTPS, with the garden's own certificates (as `tls = true` in a scenario)")
]
DATA = Path("data")


def main() -> None:
    """Run a command; a GardenError becomes one plain line and status 1."""
    for name in sorted(added()):
        _add(name)
    try:
        app()
    except GardenError as error:
        print(f"garden: {error}" + (f"\n  try: {error.hint}" if error.hint else ""), file=sys.stderr)
        sys.exit(1)


def added() -> dict[str, str]:
    """Commands that other folders bring, name to `module:function`."""
    return {point.name: point.value for point in entry_points(group=GROUP)}


def _add(name: str) -> None:
    """Import the command's module only when it is the one asked for."""
    if name in sys.argv[1:2]:
        app.command(name)(_load(name))
    else:
        app.command(name, help=HELP.get(name, ""))(lambda: None)


HELP = {
    "bench": "Measure ours and a peer side by side.",
    "emulate": "One device's emulator on a pseudo-terminal.",
    "evaluate": "Judge a detector on labelled images.",
    "reproduce": "Run a paper's experiment, ours beside the paper's.",
    "see": "What a detector makes of one image.",
    "train": "Fit a detector again from labelled images.",
}


def _load(name: str) -> Any:
    module, _, function = added()[name].partition(":")
    try:
        return getattr(importlib.import_module(module), function)
    except (ImportError, AttributeError) as error:
        print(f"garden: `garden {name}` is not installed whole: {error}", file=sys.stderr)
        sys.exit(1)


@app.command()
def up(
    scenario: Annotated[str, typer.Option(help="A built-in scenario's name, or a file")] = "garden",
    seed: Annotated[int | None, typer.Option(min=0, help="Instead of the scenario's")] = None,
    speed: Annotated[float | None, typer.Option(min=0.01, max=100, help="Garden seconds a second (default 3)")] = None,
    data: Data = DATA,
    fresh: Annotated[bool, typer.Option("--fresh", help="A new world instead of the last one, gone on with")] = False,
    shift: Annotated[int, typer.Option(envvar="GARDEN_SHIFT", help="Add this to every port")] = 0,
    tls: Tls = False,
    as_json: Json = False,
) -> None:
    """Start a whole garden here: world, pots, station, robots, console. Ctrl-C ends it."""
    from console.folder import Folder
    from console.processes import World
    from console.up import Wish
    from console.up import up as start

    start(Wish(scenario, Folder(data), World(seed, speed, fresh), shift, tls, as_json))


@app.command()
def demo(
    speed: Annotated[float | None, typer.Option(min=0.1, max=20, help="Garden seconds a second (default 3)")] = None,
    data: Annotated[Path | None, typer.Option("--data", help="Keep logs and documents here")] = None,
    as_json: Json = False,
) -> None:
    """Two minutes: the winning robot is killed on its way, and the task goes to the other."""
    from console.demo import demo as play

    play(speed, data, as_json)


@app.command()
def record(
    file: Annotated[Path, typer.Argument(help="Where to: run.mcap")],
    for_s: Annotated[float | None, typer.Option("--for", min=0.1, help="Seconds; until Ctrl-C if not given")] = None,
    camera_s: Annotated[float, typer.Option("--camera-every", min=0, help="Seconds between pictures; 0: none")] = 2.0,
    data: Data = DATA,
    as_json: Json = False,
) -> None:
    """Record a running garden as MCAP: states, tasks, events, poses, pictures. Foxglove opens it."""
    from console import record as tape

    tape.record(file, for_s, tape.Every(camera_s=camera_s), data, as_json)


@app.command()
def init(
    scenario: Annotated[str, typer.Option(help="Whose nodes to enrol")] = "garden",
    data: Data = DATA,
    owner: Annotated[int, typer.Option(help="Give the files to this user id (for containers)")] = -1,
    as_json: Json = False,
) -> None:
    """Make the garden's key and every node's key and token; what exists is kept."""
    from console import manage

    manage.init(scenario, data, owner, as_json)


@app.command()
def token(
    role: Annotated[str, typer.Option(help="operator or viewer")] = "operator",
    data: Data = DATA,
    as_json: Json = False,
) -> None:
    """Print a token for curl: `-H "Authorization: Bearer $(garden token)"`."""
    from console import manage

    manage.token(role, data, as_json)


@app.command()
def status(
    watch: Annotated[bool, typer.Option("--watch", "-w", help="Keep it on the screen")] = False,
    data: Data = DATA,
    as_json: Json = False,
) -> None:
    """Pots, robots, station and tasks in one picture."""
    from console import ask

    ask.status(data, watch, as_json)


@app.command()
def plants(data: Data = DATA, as_json: Json = False) -> None:
    """Every pot: its soil, its fruit, what it asks for, why nothing happens."""
    from console import ask

    ask.plants(data, as_json)


@app.command()
def robots(data: Data = DATA, as_json: Json = False) -> None:
    """Every robot: where it is, what it does, why it waits."""
    from console import ask

    ask.robots(data, as_json)


@app.command()
def tasks(
    task_id: Annotated[str, typer.Argument(help="Tell this task's story: who bid what, who won, why")] = "",
    diagram: Annotated[bool, typer.Option("--diagram", help="As a message sequence, time downwards")] = False,
    out: Annotated[Path | None, typer.Option("--out", help="Draw it to a file: .svg, .mmd (Mermaid) or .txt")] = None,
    data: Data = DATA,
    as_json: Json = False,
) -> None:
    """All tasks, or one task's story from the pot's and the robots' own histories."""
    from console import ask

    ask.tasks(task_id, diagram, out, data, as_json)


Within = Annotated[float | None, typer.Option(help="Seconds by which a robot must have begun it, else it fails")]
Priority = Annotated[int, typer.Option(min=0, max=9, help="Higher goes first in a robot's queue")]


@app.command()
def water(
    plant: Annotated[str, typer.Argument(help="Which pot")],
    ml: Annotated[float | None, typer.Option("--ml", help="How much (the pot's own dose if not given)")] = None,
    within: Within = None,
    priority: Priority = 5,
    data: Data = DATA,
    as_json: Json = False,
) -> None:
    """Ask a pot to have itself watered."""
    from console import ask

    ask.water(plant, ml, within, priority, data, as_json)


@app.command()
def harvest(
    count: Annotated[int, typer.Argument(min=1, max=200, help="How many ripe fruit")],
    plant: Annotated[str, typer.Option(help="Only from this pot")] = "",
    wait: Annotated[bool, typer.Option(help="Tell how it goes until it has ended")] = True,
    within: Within = None,
    priority: Priority = 5,
    data: Data = DATA,
    as_json: Json = False,
) -> None:
    """Order ripe fruit: split over the pots, each finds a robot to pick its part."""
    from console import ask

    ask.harvest(count, plant, wait, within, priority, data, as_json)


@app.command()
def cancel(
    name: Annotated[str, typer.Argument(metavar="ID", help="A task's id, or an order's")],
    data: Data = DATA,
    as_json: Json = False,
) -> None:
    """Call off a task, or an order with all its tasks."""
    from console import ask

    ask.cancel(name, data, as_json)


Robot = Annotated[str, typer.Argument(help="Which robot")]
AnyRobot = Annotated[str, typer.Argument(help="Which robot; all of them if not given")]
Wait = Annotated[bool, typer.Option("--wait", help="Come back when the job has ended")]


@app.command()
def stop(
    robot: AnyRobot = "",
    reason: Annotated[str, typer.Option(help="Shown to everybody")] = "",
    data: Data = DATA,
    as_json: Json = False,
) -> None:
    """Stop at once, and stay stopped until `garden resume`."""
    from console import ask

    ask.stop(robot, reason, data, as_json)


@app.command()
def resume(
    robot: AnyRobot = "",
    stop: Annotated[int, typer.Option(help="Which stop, as `garden robots` shows it; the one latched now if not given")] = 0,
    data: Data = DATA,
    as_json: Json = False,
) -> None:
    """Let stopped robots go on."""
    from console import ask

    ask.resume(robot, stop, data, as_json)


@app.command(context_settings={"ignore_unknown_options": True})
def goto(
    robot: Robot,
    x_m: Annotated[float, typer.Argument(help="World x [m]")],
    y_m: Annotated[float, typer.Argument(help="World y [m]")],
    yaw_deg: Annotated[float | None, typer.Argument(help="Heading [degrees, counter-clockwise from x]")] = None,
    wait: Wait = False,
    data: Data = DATA,
    as_json: Json = False,
) -> None:
    """Drive a robot somewhere."""
    from console import ask

    ask.goto(robot, x_m, y_m, yaw_deg, wait, data, as_json)


@app.command()
def dock(
    robot: Robot,
    where: Annotated[str, typer.Argument(help="A pot's id, or station/DOCK")],
    wait: Wait = False,
    data: Data = DATA,
    as_json: Json = False,
) -> None:
    """Dock a robot."""
    from console import ask

    ask.job(robot, "dock", where, wait, data, as_json)


@app.command()
def undock(robot: Robot, wait: Wait = False, data: Data = DATA, as_json: Json = False) -> None:
    """Back a robot out of its dock."""
    from console import ask

    ask.job(robot, "undock", "", wait, data, as_json)


@app.command()
def home(robot: Robot, wait: Wait = False, data: Data = DATA, as_json: Json = False) -> None:
    """Send a robot home."""
    from console import ask

    ask.job(robot, "home", "", wait, data, as_json)


@app.command()
def doctor(data: Data = DATA, as_json: Json = False) -> None:
    """Look for what is missing or in the way."""
    from console.doctor import doctor as look

    look(data, as_json)


@app.command()
def compose(
    scenario: Annotated[str, typer.Option(help="A built-in scenario's name, or a file")] = "garden",
    tls: Tls = False,
    as_json: Json = False,
) -> None:
    """Print the docker-compose.yml of a scenario."""
    from console.compose import compose as write

    write(scenario, as_json, tls)


@app.command()
def manifests(
    scenario: Annotated[str, typer.Option(help="A built-in scenario's name")] = "garden", tls: Tls = False
) -> None:
    """Print the Kubernetes objects of a scenario."""
    from console.kubernetes import manifests as written

    print(written(scenario, tls), end="")


@app.command()
def health() -> None:
    """Whether this container's service is ready (for HEALTHCHECK)."""
    from console import health as healthy

    healthy.main()


if __name__ == "__main__":
    main()
