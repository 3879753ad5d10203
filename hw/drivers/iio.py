"""A soil probe behind a converter that Linux drives: the IIO sysfs tree. Fills `hw.ports.SoilProbe`.

`<root>/iio:deviceN/` holds `name`, `in_voltageM_raw`, `in_voltageM_scale` or `in_voltage_scale` (millivolts a count) and
perhaps `in_voltageM_offset`; volts = (raw + offset) * scale / 1000.
"""

from __future__ import annotations

import errno
import logging
import os
from pathlib import Path

import structlog

from core.clock import Clock
from core.errors import DriverError, LinkDown
from hw.ports import LinkStatus

ROOT = Path("/sys/bus/iio/devices")
SAMPLE_INTERVAL_S = 0.02
LOOK_S = 5.0
READ_COST_S = 0.001
WHY = {
    errno.ENOENT: "the device or its channel is gone",
    errno.EBUSY: "the converter is busy (a buffered capture?)",
    errno.ETIMEDOUT: "the converter did not answer",
    errno.EACCES: "this user may not read it",
}


class IioProbe:
    """One channel of an IIO device, found by `device` (its `name`, or its index) under `root`."""

    def __init__(self, root: Path, device: str | int, channel: int, clock: Clock) -> None:
        self._root, self._device, self._channel, self._clock = root, device, channel, clock
        self._status = LinkStatus(up=False, why="not looked yet", since_s=0.0)
        self._log = structlog.get_logger().bind(device="iio", root=str(root), channel=channel)

    @property
    def link(self) -> LinkStatus:
        return self._status

    async def sample(self, count: int) -> tuple[float, ...]:
        """`count` voltages [V], 20 ms apart. Raises LinkDown when the files say no, DriverError when they hold nonsense."""
        volts = []
        for taken in range(count):
            if taken:
                await self._clock.sleep(SAMPLE_INTERVAL_S)
            volts.append(await self._read())
        return tuple(volts)

    async def run(self) -> None:
        """Looks for the device now and then, so that `link` is true without anybody sampling."""
        while True:
            try:
                await self._read()
            except (LinkDown, DriverError):
                self._log.debug("not readable", why=self._status.why)
            await self._clock.sleep(LOOK_S)

    async def _read(self) -> float:
        try:
            volts = await self._clock.offload(self._volts, READ_COST_S)
        except OSError as error:
            why = WHY.get(error.errno or 0, error.strerror or str(error))
            self._say(False, f"{error.filename}: {why}" if error.filename else why)
            raise LinkDown(f"cannot read the soil probe: {self._status.why}") from error
        except ValueError as error:
            self._say(False, f"a file holds no number: {error}")
            raise DriverError(f"cannot read the soil probe: {self._status.why}") from error
        self._say(True, "the converter answers")
        return volts

    def _volts(self) -> float:
        folder = self._folder()
        own = f"in_voltage{self._channel}"
        raw = float(_text(folder / f"{own}_raw"))
        scale = _first(folder, f"{own}_scale", "in_voltage_scale")
        offset = _first(folder, f"{own}_offset", "in_voltage_offset")
        if scale is None:
            raise FileNotFoundError(errno.ENOENT, "no scale", str(folder / f"{own}_scale"))
        return (raw + (offset or 0.0)) * scale / 1000.0

    def _folder(self) -> Path:
        if isinstance(self._device, int):
            return self._root / f"iio:device{self._device}"
        for folder in sorted(self._root.glob("iio:device*")):
            if _name(folder) == self._device:
                return folder
        raise FileNotFoundError(errno.ENOENT, "no such device", f"{self._root} ({self._device})")

    def _say(self, up: bool, why: str) -> None:
        if up != self._status.up or self._status.since_s == 0.0:
            self._status = LinkStatus(up=up, why=why, since_s=self._clock.now())
            self._log.log(logging.INFO if up else logging.WARNING, f"link {'up' if up else 'down'}", why=why)
        elif why != self._status.why:
            self._status = LinkStatus(up=up, why=why, since_s=self._status.since_s)


def _text(path: Path) -> str:
    """A sysfs attribute; an OSError from the read names the file, as one from opening does."""
    try:
        return path.read_text(encoding="ascii").strip()
    except OSError as error:
        raise OSError(error.errno, error.strerror or os.strerror(error.errno or 0), str(path)) from error


def _name(folder: Path) -> str | None:
    try:
        return _text(folder / "name")
    except OSError:
        return None


def _first(folder: Path, *names: str) -> float | None:
    for name in names:
        if (folder / name).exists():
            return float(_text(folder / name))
    return None
