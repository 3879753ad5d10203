"""pycreate2 and pyroombaadapter, unchanged, against the emulated Create over a pseudo-terminal."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest


@pytest.fixture
def emulated(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[str]:
    """A device of `garden emulate` in a process of its own; ends it by SIGTERM and looks that it cleans up."""
    path = tmp_path / "tty"
    command = [sys.executable, "-m", "sim.devices.emulate", request.param, "--pty", str(path)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline().strip() == str(path)
    yield str(path)
    process.send_signal(signal.SIGTERM)
    assert process.wait(timeout=10) == 0
    process.stdout.close()
    assert not path.is_symlink()


def on(device: str) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("emulated", [device], indirect=True)


@on("create2")
def test_pycreate2_drives_and_senses_a_create_2(emulated: str) -> None:
    pycreate2 = pytest.importorskip("pycreate2", reason="pip install robot-garden[conformance]")
    bot = pycreate2.Create2(emulated)
    bot.start()
    bot.safe()
    bot.drive_direct(200, 100)
    time.sleep(0.5)
    sensors = bot.get_sensors()
    assert sensors.open_interface_mode == 2
    assert (sensors.velocity_right, sensors.velocity_left) == (200, 100)
    assert 30 < sensors.distance < 200
    assert sensors.angle > 5
    assert sensors.encoder_counts_right > 1.5 * sensors.encoder_counts_left > 0
    assert sensors.battery_charge / sensors.battery_capacity > 0.5
    assert sensors.cliff_left_signal > 1000
    bot.led(4, 255, 128)
    bot.digit_led_ascii("ABCD")


@on("create2")
def test_pyroombaadapter_drives_streams_and_docks_a_create_2(emulated: str) -> None:
    adapters = pytest.importorskip("pyroombaadapter", reason="pip install robot-garden[conformance]")
    adapter = adapters.PyRoombaAdapter(emulated)
    adapter.send_drive_direct(100, 100)
    time.sleep(0.5)
    assert 20 < adapter.request_distance() < 100
    assert adapter.request_oi_mode() == 2
    assert adapter.request_charging_state() == 0
    assert 15_000 < adapter.request_voltage() < 22_000
    adapter.move(0.2, 0.0)
    assert adapter._request_sensor("Requested Radius") == 2000, "its straight is a wide arc to the left"
    adapter.data_stream_start(["Requested Velocity", "OI Mode"])
    time.sleep(0.1)
    assert adapter.data_stream_read() == [200, 2]
    adapter.data_stream_stop()
    time.sleep(0.1)
    adapter.serial_con.reset_input_buffer()
    adapter.start_seek_dock()
    time.sleep(0.2)
    assert adapter.request_oi_mode() == 1
    adapter.request_distance()
    time.sleep(0.5)
    assert adapter.request_distance() > 20, "it drives itself"


@on("create1")
def test_pyroombaadapter_senses_a_create_1_but_refuses_its_stream(emulated: str) -> None:
    adapters = pytest.importorskip("pyroombaadapter", reason="pip install robot-garden[conformance]")
    adapter = adapters.PyRoombaAdapter(emulated)
    adapter.send_drive_cmd(-200, 500)
    time.sleep(0.5)
    assert adapter.request_distance() < -30
    assert adapter.request_oi_mode() == 2
    adapter.data_stream_start(["OI Mode"])
    time.sleep(0.1)
    assert adapter.data_stream_read() == [], "a Create 1 leaves the header out of its checksum"


@on("create2")
def test_the_terminal_survives_clients_that_come_and_go(emulated: str) -> None:
    serial = pytest.importorskip("serial")
    for _ in range(3):
        with serial.Serial(emulated, 115200, timeout=1) as port:
            port.write(b"\x80\x8e\x23")
            assert port.read(1) == b"\x01"
