"""The dose ledger: caps by the hour and the day, and nothing acknowledged is forgotten under SIGKILL."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from pathlib import Path

import pytest

from core.clock import VirtualClock
from core.errors import StorageError
from core.store import DurableDocument
from core.virtual import run_virtual
from robot_service.body.caps import STOP_SCHEMA, Caps, Ledger, StopLatch

ROOT = Path(__file__).parents[3]
CAPS = Caps(command_ml=100.0, hour_ml=150.0, day_ml=250.0)

WRITER = """
import asyncio, sys
from pathlib import Path
from core.clock import WallClock
from robot_service.body.caps import Caps, Ledger

async def main():
    ledger = Ledger(Path(sys.argv[1]), Caps(), WallClock())
    ledger.load()
    for i in range(100000):
        await ledger.debit(f"{sys.argv[2]}/{i}", 1.0)
        print(f"{sys.argv[2]}/{i}", flush=True)

asyncio.run(main())
"""


def opened(folder: Path, clock: VirtualClock) -> Ledger:
    ledger = Ledger(folder, CAPS, clock)
    ledger.load()
    return ledger


def test_the_caps_a_command_an_hour_and_a_day(tmp_path: Path) -> None:
    async def main() -> None:
        clock = VirtualClock(0.0)
        ledger = opened(tmp_path, clock)
        assert "cap of 100 ml" in ledger.refusal(100.1)
        await ledger.debit("a", 100.0)
        assert ledger.refusal(50.0) == ""
        assert "150 ml an hour" in ledger.refusal(50.1)
        await clock.sleep(3601)
        await ledger.debit("b", 100.0)
        await clock.sleep(3601)
        assert "250 ml a day" in ledger.refusal(51.0)
        await clock.sleep(86400 - 2 * 3600)
        assert ledger.refusal(100.0) == ""
        ledger.close()

    run_virtual(main())


def test_a_permit_is_written_off_once(tmp_path: Path) -> None:
    async def main() -> None:
        ledger = opened(tmp_path, VirtualClock())
        await ledger.debit("a", 10.0)
        with pytest.raises(StorageError, match="spent"):
            await ledger.debit("a", 10.0)
        ledger.close()

    run_virtual(main())


@pytest.mark.parametrize("wakes_s", [5.0, 1e6, 1e7], ids=["began-anew", "went-on", "leapt"])
def test_doses_of_another_clock_still_count_for_a_day_and_no_longer(tmp_path: Path, wakes_s: float) -> None:
    async def main() -> None:
        before = opened(tmp_path, VirtualClock(1e6))
        await before.debit("a", 100.0)
        before.close()
        clock = VirtualClock(wakes_s)
        after = opened(tmp_path, clock)
        assert after.spent("a")
        assert "hour" in after.refusal(60.0)
        await clock.sleep(86401)
        assert after.debited_since_ml(clock.now() - 86400) == 0.0
        after.close()

    run_virtual(main())


def test_after_sigkill_every_acknowledged_permit_is_spent(tmp_path: Path) -> None:
    acknowledged: list[str] = []
    for run in range(4):
        command = [sys.executable, "-c", WRITER, str(tmp_path), f"run-{run}"]
        with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as writer:
            assert writer.stdout is not None
            acknowledged += [writer.stdout.readline().strip() for _ in range(5 + 7 * run)]
            writer.kill()
            acknowledged += writer.stdout.read().split()

    async def main() -> None:
        ledger = opened(tmp_path, VirtualClock())
        assert len(acknowledged) >= 60
        assert all(ledger.spent(permit) for permit in acknowledged)
        ledger.close()

    run_virtual(main())


def test_the_latch_acts_although_the_disk_does_not(tmp_path: Path) -> None:
    async def main() -> None:
        latch = StopLatch(tmp_path, VirtualClock())
        assert latch.stopped
        latch.load()
        assert not latch.stopped
        latch.press("anna")
        await latch.keep()
        assert latch.kept
        assert await latch.release(latch.number)
        latch.close()
        latch.press("anna")
        with pytest.raises(StorageError):
            await latch.keep()
        assert (latch.stopped, latch.by, latch.kept) == (True, "anna", False)
        assert latch.number == 0, "a crash would take the number back"
        with pytest.raises(StorageError):
            await latch.release(2)
        assert latch.stopped

    run_virtual(main())


def test_every_press_has_a_number_of_its_own_over_restarts_and_only_that_releases_it(tmp_path: Path) -> None:
    async def main() -> None:
        for number in range(1, 6):
            latch = StopLatch(tmp_path, VirtualClock())
            latch.load()
            latch.press("anna")
            assert latch.number == 0
            await latch.keep()
            assert latch.number == number
            for other in (0, number - 1, number + 1):
                assert not await latch.release(other)
            assert (latch.stopped, latch.number) == (True, number)
            if number % 2:
                assert await latch.release(number)
                assert (latch.stopped, latch.number) == (False, 0)
                assert not await latch.release(number), "nothing is latched"
            latch.close()

    run_virtual(main())


def test_a_press_while_a_release_is_written_down_stays_latched(tmp_path: Path) -> None:
    async def main() -> None:
        latch = StopLatch(tmp_path, VirtualClock())
        latch.load()
        latch.press("anna")
        await latch.keep()
        releasing = asyncio.ensure_future(latch.release(1))
        await asyncio.sleep(0)
        latch.press("a child")
        assert not await releasing
        await latch.keep()
        assert (latch.stopped, latch.by, latch.number) == (True, "a child", 2)
        latch.close()
        again = StopLatch(tmp_path, VirtualClock())
        again.load()
        assert (again.stopped, again.by, again.number) == (True, "a child", 2)
        again.close()

    run_virtual(main())


def test_a_latch_written_by_an_earlier_version_can_be_released(tmp_path: Path) -> None:
    async def main() -> None:
        document = DurableDocument(tmp_path / "stop.json", STOP_SCHEMA, VirtualClock())
        document.load()
        await document.save({"stopped": True, "by": "anna"})
        document.close()
        latch = StopLatch(tmp_path, VirtualClock())
        latch.load()
        assert (latch.stopped, latch.number) == (True, 1)
        assert await latch.release(1)
        latch.close()

    run_virtual(main())
