"""The whole garden in one document, gathered from everybody at once."""

from __future__ import annotations

from typing import TypeVar

from core.errors import GardenError
from core.mesh.client import Mesh
from core.mesh.peers import Peer, PeerKind, Peers
from core.wire.documents import Document
from core.wire.market import Task
from core.wire.plant import PlantState, StationState
from core.wire.robot import RobotState

D = TypeVar("D")


class Silent(Document):
    """Somebody who did not answer, and why."""

    id: str
    kind: PeerKind
    why: str


class Snapshot(Document):
    plants: list[PlantState] = []
    robots: list[RobotState] = []
    stations: list[StationState] = []
    tasks: list[Task] = []
    """Newest first."""
    silent: list[Silent] = []


async def look(mesh: Mesh, peers: Peers) -> Snapshot:
    """Ask every pot, robot and station for its state; whoever is silent is listed as such."""
    silent: list[Silent] = []
    plants = await _states(mesh, peers.of_kind("plant"), PlantState, silent)
    robots = await _states(mesh, peers.of_kind("robot"), RobotState, silent)
    stations = await _states(mesh, peers.of_kind("station"), StationState, silent)
    tasks = await all_tasks(mesh, peers)
    return Snapshot(plants=plants, robots=robots, stations=stations, tasks=tasks, silent=silent)


async def all_tasks(mesh: Mesh, peers: Peers) -> list[Task]:
    """Every pot's tasks, newest first."""
    lists = await _states(mesh, peers.of_kind("plant"), list[Task], [], "/tasks")
    return sorted((task for tasks in lists for task in tasks), key=lambda task: (-task.created_s, task.task_id))


async def _states(mesh: Mesh, asked: list[Peer], expect: type[D], silent: list[Silent], path: str = "/state") -> list[D]:
    answers = await mesh.ask_all(asked, "GET", path, expect=expect)
    found: list[D] = []
    for peer in asked:
        answer = answers[peer.id]
        if isinstance(answer, GardenError):
            silent.append(Silent(id=peer.id, kind=peer.kind, why=str(answer)[:300]))
        else:
            found.append(answer)
    return found
