from __future__ import annotations

import asyncio
import errno
from collections.abc import Callable
from pathlib import Path

import pytest
from structlog.testing import capture_logs

from core.clock import VirtualClock
from core.errors import ConfigError, DriverError, LinkDown
from core.virtual import run_virtual
from hw.drivers import iio
from hw.drivers.iio import IioProbe
from hw.drivers.probes import open_probe
from hw.links import MemoryNet

MakeDevice = Callable[..., Path]
SCALE = 5000 / 1024


@pytest.fixture
def converter(iio_device: MakeDevice) -> Path:
    """Two devices; the second is the converter, at 1.5 V on channel 2."""
    iio_device(0, "bme280", in_temp_raw=1)
    return iio_device(1, "mcp3008", in_voltage2_raw=307, in_voltage_scale=SCALE)


def probe(converter: Path, device: str | int = "mcp3008", channel: int = 2) -> IioProbe:
    return IioProbe(converter.parent, device, channel, VirtualClock())


@pytest.mark.parametrize("device", ["mcp3008", 1])
def test_a_converter_is_found_by_name_or_index(converter: Path, device: str | int) -> None:
    volts = run_virtual(probe(converter, device).sample(3))
    assert volts == pytest.approx((307 * SCALE / 1000,) * 3)


def test_its_own_scale_and_offset_come_before_the_shared_ones(converter: Path) -> None:
    (converter / "in_voltage2_scale").write_text("2.0\n")
    (converter / "in_voltage2_offset").write_text("-7\n")
    assert run_virtual(probe(converter).sample(1)) == (0.6,)


def test_samples_are_taken_apart(converter: Path) -> None:
    async def story() -> float:
        await probe(converter).sample(5)
        return asyncio.get_running_loop().time()

    assert run_virtual(story()) == pytest.approx(0.08, abs=0.01)


def move(source: Path, target: Path) -> None:
    source.rename(target)


def test_a_missing_device_is_down_with_a_reason_and_comes_back(converter: Path) -> None:
    away = converter.parent / "unbound"

    async def story() -> None:
        adc = probe(converter)
        loop = asyncio.create_task(adc.run())
        await asyncio.sleep(1)
        assert adc.link.up
        move(converter, away)
        with pytest.raises(LinkDown, match="gone"):
            await adc.sample(1)
        assert not adc.link.up
        assert "mcp3008" in adc.link.why
        move(away, converter)
        await asyncio.sleep(6)
        assert adc.link.up
        assert len(await adc.sample(2)) == 2
        loop.cancel()

    with capture_logs() as logs:
        run_virtual(story())
    assert [log["event"] for log in logs if "link" in log["event"]] == ["link up", "link down", "link up"]


@pytest.mark.parametrize(
    ("code", "why"), [(errno.EBUSY, "busy"), (errno.ETIMEDOUT, "did not answer"), (errno.EACCES, "may not read")]
)
def test_the_kernels_refusals_are_named(converter: Path, monkeypatch: pytest.MonkeyPatch, code: int, why: str) -> None:
    def refuse(path: Path) -> str:
        if path.name.endswith("_raw"):
            raise OSError(code, "refused", str(path))
        return path.read_text().strip()

    async def story() -> None:
        adc = probe(converter)
        with monkeypatch.context() as patch:
            patch.setattr(iio, "_text", refuse)
            with pytest.raises(LinkDown, match=why):
                await adc.sample(1)
            assert why in adc.link.why
        assert len(await adc.sample(1)) == 1
        assert adc.link.up

    run_virtual(story())


def test_a_missing_channel_is_down_and_nonsense_is_an_error(converter: Path) -> None:
    with pytest.raises(LinkDown, match="in_voltage5_raw"):
        run_virtual(probe(converter, channel=5).sample(1))
    (converter / "in_voltage2_raw").write_text("busy?\n")
    with pytest.raises(DriverError, match="no number"):
        run_virtual(probe(converter).sample(1))


def test_a_url_names_root_device_and_channel(converter: Path) -> None:
    net = MemoryNet(VirtualClock())
    adc = open_probe(f"iio://{converter.parent}?name=mcp3008&channel=2", net.open, VirtualClock())
    assert run_virtual(adc.sample(1))[0] == pytest.approx(1.499, abs=0.001)


@pytest.mark.parametrize("query", ["", "?channel=0", "?name=a&index=0", "?index=one", "?name=a&channel=x"])
def test_a_url_that_leaves_doubt_is_refused(query: str) -> None:
    net = MemoryNet(VirtualClock())
    with pytest.raises(ConfigError):
        open_probe(f"iio:///sys/bus/iio/devices{query}", net.open, VirtualClock())
