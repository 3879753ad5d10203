"""`garden demo`: two minutes in which the winning robot's brain is killed on its way, and the task goes to the other.

Everything shown is asked for over HTTP while it happens: the pot's task, the robots' histories, the world's truth.
"""

from __future__ import annotations

import asyncio
import json
import signal
import tempfile
from collections.abc import Awaitable, Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from math import hypot
from pathlib import Path
from typing import Any

from console import diagram, toml
from console.folder import Folder
from console.ports import on_free_ports
from console.processes import Process, World, processes
from console.runner import Runner
from console.story import Step, Story, tell
from console.up import Voice, only_one
from core import scenario as scenarios
from core.clock import WallClock
from core.errors import GardenError, PeerDown
from core.mesh.chassis import Readiness
from core.mesh.client import Mesh
from core.mesh.http import HttpTransport
from core.mesh.peers import Peer
from core.scenario import Scenario
from core.wire.documents import HistoryEntry
from core.wire.market import FINAL_STATES, Task
from core.wire.robot import RobotState

DRY, DRY_RATIO, MOIST_RATIO, TARGET_RATIO = "plant-1", 0.175, 0.35, 0.21
POTS = ("plant-1", "plant-4")
POLL_S = 0.2
READY_WITHIN_S = 120.0
STAGE_WITHIN_S = 180.0
"""Any one thing that should happen takes no longer than this, on the slowest machine [wall s]."""
ON_THE_WAY_M = 0.25
"""So far it drives before it is killed: no longer at home, not yet in front of the dock."""


class Missed(GardenError):
    """What was to be shown did not happen."""

    title = "Demonstration failed"


def demo(speed: float | None, data: Path | None, as_json: bool) -> None:
    """Play it; raises Missed with the reason when something else happened. Leaves no process, and no folder unless told."""
    with ExitStack() as stack:
        root = data or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="garden-demo-")))
        folder = Folder(root)
        folder.root.mkdir(parents=True, exist_ok=True)
        stack.enter_context(only_one(folder))
        scenario = on_free_ports(stage(), folder.place())
        folder.scenario_file.write_text(toml.dump(scenario))
        folder.enrol(scenario)
        folder.remember(scenario)
        listed = processes(scenario, folder.place(), World(speed=speed, fresh=True))
        for process in listed:
            (folder.root / process.name).mkdir(parents=True, exist_ok=True)
        asyncio.run(_play(listed, folder, Voice(as_json)))


def stage() -> Scenario:
    """The default garden with two pots, one of them dry, that ask for nothing but water."""
    base = scenarios.find("garden")
    plants = [
        plant.model_copy(
            update={
                "moisture_ratio": DRY_RATIO if plant.id == DRY else MOIST_RATIO,
                "target_ratio": TARGET_RATIO,
                "inventory": False,
                "harvest": False,
            }
        )
        for plant in base.plants
        if plant.id in POTS
    ]
    return base.model_copy(update={"name": "demo", "plants": tuple(plants)})


async def _play(listed: list[Process], folder: Folder, voice: Voice) -> None:
    runner = Runner(listed, folder.logs, lambda name, what: voice.say(f"-- {name} {what}", process=name, what=what))
    mesh = Mesh(HttpTransport(), None, WallClock(), timeout_s=5.0)
    script = Script(runner, mesh, {peer.id: peer for peer in folder.peers_written()}, voice)
    running = asyncio.create_task(runner.run())
    acting = asyncio.create_task(script.play())
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        loop.add_signal_handler(number, acting.cancel)
    try:
        await asyncio.wait({running, acting}, return_when=asyncio.FIRST_COMPLETED)
        if running.done():
            running.result()  # raises why nothing could be started
    finally:
        for task in (acting, running):
            task.cancel()
        await asyncio.gather(acting, running, return_exceptions=True)
        await mesh.aclose()
        voice.say("All processes have ended.", ended=True)
    if acting.cancelled():
        raise Missed("ended early, by a signal")
    acting.result()


@dataclass(slots=True)
class Script:
    """What happens, in order. Each step waits for what should be seen, and fails saying what was not."""

    runner: Runner
    mesh: Mesh
    peers: dict[str, Peer]
    voice: Voice
    steps: list[Step] = field(default_factory=list)
    """Of the story, as first told: what a brain forgets when it is killed was heard before."""

    async def play(self) -> None:
        await self._start()
        winner = await self._award()
        await self._kill(winner)
        ended = await self._moves_from(winner)
        await self._judge(ended, winner)

    def _say(self, words: str, **more: object) -> None:
        self.voice.say(f"-- {words}", note=words, **more)

    async def _start(self) -> None:
        began_s = asyncio.get_running_loop().time()
        self._say(f"Starting {len(self.peers)} services: two pots, two robots, a station, the world, a console.")
        for peer in self.peers.values():
            await self._until(lambda peer=peer: self._ready(peer), f"{peer.id} is ready", READY_WITHIN_S)  # type: ignore[misc]
        self._say(f"All are ready after {asyncio.get_running_loop().time() - began_s:.0f} s. {DRY} is dry.")

    async def _ready(self, peer: Peer) -> bool:
        await self.mesh.call(peer, "GET", "/readyz", expect=Readiness)
        self.runner.children[peer.id].ready = True
        return True

    async def _award(self) -> str:
        """The pot asks, both bid, one wins; its id."""

        async def awarded() -> bool:
            task = await self._look()
            return task is not None and task.robot_id != ""

        await self._until(awarded, "the pot awards its task")
        task = await self._look()
        assert task is not None
        self._say(f"{task.robot_id} has the cheaper bid and gets the task.")
        return task.robot_id

    async def _kill(self, winner: str) -> None:
        home = (await self._state(winner)).pose

        async def on_its_way() -> bool:
            await self._look()
            pose = (await self._state(winner)).pose
            return home is not None and pose is not None and hypot(pose.x_m - home.x_m, pose.y_m - home.y_m) > ON_THE_WAY_M

        await self._until(on_its_way, f"{winner} drives")
        killed_s = (await self._state(winner)).now_s
        pid = self.runner.kill(winner)
        self.steps.append(Step(t_s=killed_s, source=winner, what="its brain is killed"))
        self._say(f"{winner} is on its way. SIGKILL to its brain, process {pid}: no goodbye, no report.", killed=winner)

        async def stands() -> bool:
            return not any((await self._robot_truth(winner))["wheels_mps"])

        await self._until(stands, f"the wheels of {winner} stop")
        self._say(
            f"Its body stopped the wheels by itself. {DRY} hears nothing more from it, and waits for the lease to end."
        )

    async def _moves_from(self, loser: str) -> Task:
        """The lease ends, the pot asks again, the other robot does it; the task once it has ended."""

        async def moved() -> bool:
            task = await self._look()
            return task is not None and task.robot_id not in ("", loser)

        await self._until(moved, f"the task moves from {loser} to another robot")
        self._say("The task has moved. The other robot waters, and the pot measures when the dose has soaked in.")

        async def over() -> bool:
            task = await self._look()
            return task is not None and task.state in FINAL_STATES

        await self._until(over, "the task ends")
        task = await self._look()
        assert task is not None
        return task

    async def _judge(self, task: Task, loser: str) -> None:
        """Let the killed brain come back, draw what happened, and hold it against the world's truth."""
        self.runner.start(loser)
        await self._until(lambda: self._ready(self.peers[loser]), f"{loser} is back")
        self._say(f"{loser} was started again, and bids with the others.")
        story = Story(task=task, steps=sorted(self.steps, key=lambda step: step.t_s))
        self.voice.say("\n" + diagram.text(story), story=[step.model_dump() for step in story.steps])
        truth = await self._truth()
        plant = next(plant for plant in truth["plants"] if plant["id"] == DRY)
        poured_ml, wet_ratio = plant["poured_ml"], plant["moisture_ratio"]
        told = (
            f"The world says: {poured_ml:.0f} ml in the pot, {truth['spilt_ml']:.0f} ml spilt, "
            f"water content {DRY_RATIO:.3f} before and {wet_ratio:.3f} now, one dose under one permit."
        )
        good = task.state == "done" and task.robot_id != loser and task.permits == 1 and 0 < poured_ml < 1.1 * task.dose_ml
        if not good:
            raise Missed(f"{task.task_id} is {task.state} by {task.robot_id} after {task.permits} permits; {told}")
        self._say(told, done=task.task_id, by=task.robot_id, killed=loser, poured_ml=poured_ml)

    # ------------------------------------------------------------------ looking

    async def _until(self, true: Callable[[], Awaitable[bool]], what: str, within_s: float = STAGE_WITHIN_S) -> None:
        """Wait; somebody who does not answer is looked at again. Wall seconds."""
        try:
            async with asyncio.timeout(within_s):
                while True:
                    try:
                        if await true():
                            return
                    except GardenError:
                        pass
                    await asyncio.sleep(POLL_S)
        except TimeoutError:
            raise Missed(f"not within {within_s:g} s: {what}", hint="is this machine very busy? try --speed 1") from None

    async def _look(self) -> Task | None:
        """The dry pot's first task as it is now; whatever is new of its story is told. None before there is one."""
        pot = self.peers[DRY]
        tasks = await self.mesh.call(pot, "GET", "/tasks", expect=list[Task])
        if not tasks:
            return None
        history = await self.mesh.call(pot, "GET", f"/history?task_id={tasks[0].task_id}", expect=list[HistoryEntry])
        robots = [peer for peer in self.peers.values() if peer.kind == "robot"]
        answers = await self.mesh.ask_all(robots, "GET", "/history", expect=list[HistoryEntry], timeout_s=1.0)
        heard = {name: answer for name, answer in answers.items() if not isinstance(answer, GardenError)}
        for step in tell(tasks[0], history, heard).steps:
            if step not in self.steps:
                self.steps.append(step)
                self.voice.say(f"{step.t_s:8.1f} s  {step.who:<20} {step.what}", **step.model_dump())
        return tasks[0]

    async def _state(self, robot: str) -> RobotState:
        return await self.mesh.call(self.peers[robot], "GET", "/state", expect=RobotState)

    async def _truth(self) -> dict[str, Any]:
        answer = await self.mesh.exchange(self.peers["sim"], "GET", "/truth")
        if answer.status != 200:
            raise PeerDown(f"the world answers {answer.status}")
        return dict(json.loads(answer.body))

    async def _robot_truth(self, robot: str) -> dict[str, Any]:
        return next(one for one in (await self._truth())["robots"] if one["id"] == robot)
