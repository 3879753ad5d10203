from __future__ import annotations

import asyncio
import json
from pathlib import Path

import pytest

from core.clock import VirtualClock
from core.scenario import find
from core.virtual import run_virtual
from sim.faults import FaultRequest
from sim.keeping import EVERY_S, Keeper, write_whole
from sim.wiring import Rig, assemble


def garden(folder: Path, seed: int = 7) -> tuple[Rig, Keeper]:
    rig = assemble(find("garden"), seed, VirtualClock())
    return rig, Keeper(folder, rig.world, rig.faults, rig.clockwork)


def test_a_world_goes_on_where_it_ended(tmp_path: Path) -> None:
    rig, keeper = garden(tmp_path)
    rig.world.stride(500.0)
    rig.world.teleport("robot-1", 0.3, 0.2, 1.0)
    rig.faults.add(FaultRequest(kind="soil_open", target="plant-2"))
    write_whole(keeper.path, keeper.document())
    later, keeper_later = garden(tmp_path)
    assert keeper_later.restore()
    assert later.world.time_s == rig.world.time_s
    assert later.world.truth().robot("robot-1").pose == rig.world.truth().robot("robot-1").pose
    assert later.world.truth().plants == rig.world.truth().plants
    assert later.faults.all() == rig.faults.all()
    assert later.world.pots["plant-2"].probe_fault is rig.world.pots["plant-2"].probe_fault


def test_garden_time_does_not_go_back_when_the_world_is_killed(tmp_path: Path) -> None:
    async def main() -> float:
        clock = VirtualClock()
        rig, keeper = garden(tmp_path)
        rig.clockwork.steer(speed=5.0)
        moving = asyncio.create_task(rig.clockwork.run(clock))
        keeping = asyncio.create_task(keeper.run(clock))
        await clock.sleep(7 * EVERY_S + 1.9)
        last_words = keeper.path.read_bytes()
        ended_s = rig.clockwork.beat().garden_s
        keeping.cancel()
        moving.cancel()
        await asyncio.gather(keeping, moving, return_exceptions=True)
        keeper.path.write_bytes(last_words)
        return ended_s

    ended_s = run_virtual(main())
    later, keeper = garden(tmp_path)
    assert keeper.restore()
    assert ended_s <= later.world.time_s < ended_s + 60.0


def test_a_clean_end_leaves_the_very_last_state(tmp_path: Path) -> None:
    async def main() -> float:
        clock = VirtualClock()
        rig, keeper = garden(tmp_path)
        tasks = [asyncio.create_task(rig.clockwork.run(clock)), asyncio.create_task(keeper.run(clock))]
        await clock.sleep(3.3)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        return rig.world.time_s

    ended_s = run_virtual(main())
    later, keeper = garden(tmp_path)
    assert keeper.restore()
    assert later.world.time_s == ended_s == pytest.approx(3.3, abs=0.01)


def test_without_a_checkpoint_the_world_begins(tmp_path: Path) -> None:
    assert not garden(tmp_path)[1].restore()


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: b"",
        lambda text: text[: len(text) // 2],
        lambda text: b"\xff\x00" + text,
        lambda text: b"[]",
        lambda text: json.dumps(json.loads(text) | {"schema": 99}).encode(),
        lambda text: json.dumps(json.loads(text) | {"faults": [{"kind": "x"}]}).encode(),
        lambda text: json.dumps(json.loads(text) | {"reserved_s": float("inf")}).encode(),
        lambda text: json.dumps(json.loads(text) | {"world": {"version": 1}}).encode(),
    ],
)
def test_a_bad_checkpoint_is_kept_aside_and_the_world_begins(tmp_path: Path, damage: object) -> None:
    _, keeper = garden(tmp_path)
    write_whole(keeper.path, keeper.document())
    bad = damage(keeper.path.read_bytes())  # type: ignore[operator]
    keeper.path.write_bytes(bad)
    later, again = garden(tmp_path)
    before = later.world.snapshot()
    assert not again.restore()
    assert later.world.snapshot() == before
    assert (tmp_path / "world.bad-1").read_bytes() == bad


def test_the_checkpoint_of_another_seed_is_not_taken(tmp_path: Path) -> None:
    _, keeper = garden(tmp_path, seed=8)
    write_whole(keeper.path, keeper.document())
    assert not garden(tmp_path, seed=7)[1].restore()


def test_a_world_begun_anew_is_new_but_its_time_does_not_go_back(tmp_path: Path) -> None:
    rig, keeper = garden(tmp_path)
    rig.world.stride(90_000.0)
    write_whole(keeper.path, keeper.document())
    later, again = garden(tmp_path)
    again.begin_anew()
    assert later.world.time_s == 2 * 86400.0
    assert later.world.hour == rig.world.scenario.climate.start_hour
    assert later.world.truth().plants == garden(tmp_path)[0].world.truth().plants
