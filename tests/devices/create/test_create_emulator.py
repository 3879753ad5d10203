"""The emulated Create, byte by byte and without any link."""

import asyncio
import random
from dataclasses import replace

import pytest

from core.clock import VirtualClock
from core.virtual import run_virtual
from hw.links import memory_pair
from hw.protocols import create as oi
from hw.protocols.create import Mode, Model, Op
from hw.protocols.create_sensors import Layout, StreamDecoder
from sim.devices.create import CreateEmulator
from sim.devices.host import EmulatorHost
from sim.devices.plants import CreateSense

both = pytest.mark.parametrize("model", list(Model))


class Body:
    """Senses set by hand; remembers the wheels."""

    def __init__(self) -> None:
        self.now = CreateSense()
        self.wheels = (0.0, 0.0)

    def sense(self) -> CreateSense:
        return self.now

    def set_wheels(self, left_mps: float, right_mps: float) -> None:
        self.wheels = (left_mps, right_mps)


class Robot:
    """An emulator with a stepping clock."""

    def __init__(self, model: Model = Model.CREATE2, mode: Mode = Mode.OFF, **options: object) -> None:
        self.body = Body()
        self.emulator = CreateEmulator(model, self.body, random.Random(1), start_mode=mode, **options)
        self.now_s = 100.0
        self.emulator.step(self.now_s)

    def say(self, *commands: bytes | Op) -> None:
        for command in commands:
            self.emulator.receive(oi.bare(command) if isinstance(command, Op) else command, self.now_s)

    def feel(self, **senses: object) -> None:
        self.body.now = replace(self.body.now, **senses)

    def wait(self, seconds: float, step_s: float = 0.001) -> bytes:
        heard = b""
        until_s = self.now_s + seconds
        while self.now_s < until_s - 1e-9:
            self.now_s = min(until_s, self.now_s + step_s)
            self.emulator.step(self.now_s)
            heard += self.emulator.transmit()
        return heard

    def ask(self, *commands: bytes) -> bytes:
        self.say(*commands)
        return self.wait(0.01)

    def read(self, packet: int) -> int:
        values = Layout(self.emulator.model, [packet]).unpack(self.ask(oi.sensors(packet)))
        assert values is not None
        return values[packet]

    @property
    def mode(self) -> Mode:
        return self.emulator.mode


# Modes


def test_a_robot_that_is_off_hears_nothing_but_start() -> None:
    robot = Robot()
    robot.say(Op.SAFE, Op.FULL, oi.drive_direct(100, 100), Op.SEEK_DOCK)
    assert robot.ask(oi.sensors(35)) == b""
    assert robot.mode is Mode.OFF
    robot.say(Op.START)
    assert robot.ask(oi.sensors(35)) == b"\x01"


@pytest.mark.parametrize("start", [Mode.PASSIVE, Mode.SAFE, Mode.FULL])
@pytest.mark.parametrize(
    ("op", "mode"),
    [
        (Op.START, Mode.PASSIVE),
        (Op.CONTROL, Mode.SAFE),
        (Op.SAFE, Mode.SAFE),
        (Op.FULL, Mode.FULL),
        (Op.SPOT, Mode.PASSIVE),
        (Op.COVER, Mode.PASSIVE),
        (Op.DEMO_OR_MAX, Mode.PASSIVE),
        (Op.SEEK_DOCK, Mode.PASSIVE),
        (Op.STOP, Mode.OFF),
        (Op.RESET, Mode.OFF),
    ],
)
def test_mode_commands(start: Mode, op: Op, mode: Mode) -> None:
    robot = Robot(mode=start)
    robot.say(op)
    assert robot.mode is mode


@both
def test_drive_commands_in_passive_are_consumed_and_ignored(model: Model) -> None:
    robot = Robot(model, Mode.PASSIVE)
    assert robot.ask(oi.drive(200, oi.STRAIGHT), oi.drive_direct(100, 100), oi.sensors(35)) == b"\x01"
    assert robot.body.wheels == (0.0, 0.0)


def test_a_setpoint_persists_for_ever_and_from_safe_to_full() -> None:
    robot = Robot(mode=Mode.SAFE)
    robot.say(oi.drive_direct(100, 200), Op.FULL)
    robot.wait(400, step_s=1.0)
    assert robot.body.wheels == (0.2, 0.1)
    robot.say(Op.START)
    assert robot.body.wheels == (0.0, 0.0)


@pytest.mark.parametrize("sense", ["drop_left", "drop_right", "drop_caster", "cliff_front_left", "contacts"])
def test_safe_mode_stops_in_passive_where_full_goes_on(sense: str) -> None:
    for mode, wheels in ((Mode.SAFE, (0.0, 0.0)), (Mode.FULL, (0.1, 0.1))):
        robot = Robot(mode=mode)
        robot.say(oi.drive_direct(100, 100))
        robot.feel(**{sense: True})
        robot.wait(0.02)
        assert robot.body.wheels == wheels
        assert robot.mode is (Mode.PASSIVE if mode is Mode.SAFE else Mode.FULL)


@pytest.mark.parametrize(
    ("drive", "stays"), [(oi.drive(-100, 500), True), (oi.drive(-100, 100), False), (oi.drive_direct(-100, -100), True)]
)
def test_backing_off_a_cliff_is_allowed_in_safe_mode_unless_the_turn_is_tight(drive: bytes, stays: bool) -> None:
    robot = Robot(mode=Mode.SAFE)
    robot.feel(cliff_left=True)
    robot.say(drive)
    robot.wait(0.05)
    assert (robot.mode is Mode.SAFE) is stays


def test_passive_and_idle_for_five_minutes_it_sleeps_until_start() -> None:
    robot = Robot(mode=Mode.PASSIVE)
    robot.say(Op.START)
    robot.wait(299, step_s=1.0)
    assert robot.mode is Mode.PASSIVE
    robot.wait(2, step_s=0.5)
    assert robot.mode is Mode.OFF
    assert robot.ask(oi.sensors(35)) == b""
    robot.say(Op.START)
    assert robot.read(35) == 1


def test_reset_is_deaf_for_the_boot_and_prints_its_text() -> None:
    robot = Robot(mode=Mode.FULL)
    robot.say(oi.drive_direct(100, 100), Op.RESET)
    assert robot.body.wheels == (0.0, 0.0)
    robot.say(Op.START)
    assert robot.wait(4.9) == b""
    assert robot.mode is Mode.OFF
    assert robot.wait(0.2).startswith(b"bl-start")
    robot.say(Op.START)
    assert robot.mode is Mode.PASSIVE


# Driving


@pytest.mark.parametrize(
    ("command", "left", "right"),
    [
        ("89 00 c8 80 00", 0.2, 0.2),
        ("89 00 c8 7f ff", 0.2, 0.2),
        ("89 00 64 00 01", -0.1, 0.1),
        ("89 00 64 ff ff", 0.1, -0.1),
        ("89 00 c8 00 00", 0.2, 0.2),
        ("89 ff 38 01 f4", -0.153, -0.247),
        ("89 00 c8 07 d0", 0.188, 0.212),
        ("89 01 f4 00 64", -0.088, 0.5),
        ("91 00 64 ff 9c", -0.1, 0.1),
        ("91 7f ff 80 00", -0.5, 0.5),
        ("92 00 ff ff 81", -0.249, 0.5),
    ],
)
def test_drive_commands_become_rim_speeds(command: str, left: float, right: float) -> None:
    robot = Robot(mode=Mode.FULL)
    robot.say(bytes.fromhex(command))
    assert robot.body.wheels == pytest.approx((left, right), abs=0.001)


def test_requested_speeds_are_told() -> None:
    robot = Robot(mode=Mode.FULL)
    robot.say(oi.drive(-200, 500))
    assert [robot.read(packet) for packet in (39, 40, 41, 42)] == [-200, 500, 0, 0]
    robot.say(oi.drive_direct(100, -100))
    assert [robot.read(packet) for packet in (39, 40, 41, 42)] == [0, 0, 100, -100]


def test_commands_may_come_byte_by_byte_or_glued() -> None:
    robot = Robot()
    for byte in b"\x80\x84\x91\x00\x64\x00\x64":
        robot.say(bytes([byte]))
    assert robot.body.wheels == (0.1, 0.1)
    robot.say(bytes.fromhex("8c 00 01 46 00 8d 00 91 00 00 00 00"))
    assert robot.body.wheels == (0.0, 0.0)


# Sensors


@both
def test_answers_come_five_milliseconds_after_the_question(model: Model) -> None:
    robot = Robot(model, Mode.PASSIVE)
    robot.say(oi.sensors(35))
    assert robot.wait(0.004) == b""
    assert robot.emulator.due_s() == pytest.approx(robot.now_s + 0.001)
    assert robot.wait(0.001) == b"\x01"


@pytest.mark.parametrize(
    ("model", "group", "size"),
    [(Model.CREATE1, 6, 52), (Model.CREATE2, 100, 80), (Model.CREATE1, 100, 0), (Model.CREATE1, 43, 0)],
)
def test_groups_are_answered_whole_and_unknown_packets_not_at_all(model: Model, group: int, size: int) -> None:
    assert len(Robot(model, Mode.PASSIVE).ask(oi.sensors(group))) == size


def test_a_query_is_answered_back_to_back() -> None:
    robot = Robot(mode=Mode.PASSIVE)
    robot.feel(bump_left=True, left_m=0.123, right_m=0.123)
    assert robot.ask(oi.query((19, 7, 17, 22))) == bytes.fromhex("00 7b 02 00 4b 00")


@pytest.mark.parametrize(
    ("senses", "packet", "value"),
    [
        ({"bump_right": True}, 7, 1),
        ({"bump_left": True}, 7, 2),
        ({"drop_right": True}, 7, 4),
        ({"drop_left": True}, 7, 8),
        ({"drop_caster": True}, 7, 16),
        ({"wall": True}, 8, 1),
        ({"cliff_left": True}, 9, 1),
        ({"cliff_front_left": True}, 10, 1),
        ({"cliff_front_right": True}, 11, 1),
        ({"cliff_right": True}, 12, 1),
        ({"ir_field": True}, 13, 1),
        ({"ir_red": True, "ir_green": True}, 17, 252),
        ({}, 17, 255),
        ({}, 14, 0),
        ({"current_a": -1.5}, 23, -1500),
        ({"temperature_c": -3.0}, 24, -3),
        ({"charge_ah": 3.0}, 25, 3000),
        ({"contacts": True}, 34, 2),
    ],
)
def test_senses_appear_in_their_packets(senses: dict[str, object], packet: int, value: int) -> None:
    robot = Robot(Model.CREATE1, Mode.PASSIVE)
    robot.feel(**senses)
    assert robot.read(packet) == value


def test_cliff_signals_are_large_over_the_floor_and_small_over_the_edge() -> None:
    robot = Robot(mode=Mode.PASSIVE)
    robot.feel(cliff_right=True)
    assert robot.read(31) < 100 < 2000 < robot.read(28)


def test_distance_and_angle_count_since_they_were_read_and_carry_their_fractions() -> None:
    robot = Robot(Model.CREATE1, Mode.PASSIVE)
    seen = []
    for tick in range(1, 101):
        robot.feel(left_m=0.0005 * tick, right_m=0.0011 * tick)
        seen.append((robot.read(19), robot.read(20)))
    assert sum(way for way, _ in seen) == 80
    assert sum(turn for _, turn in seen) == 13
    assert robot.read(19) == 0


def test_without_carry_fast_reading_loses_the_fractions() -> None:
    robot = Robot(Model.CREATE1, Mode.PASSIVE, carry=False)
    for tick in range(1, 101):
        robot.feel(left_m=0.0005 * tick, right_m=0.0011 * tick)
        assert (robot.read(19), robot.read(20)) == (0, 0)


def test_distance_is_capped_and_encoders_wrap() -> None:
    robot = Robot(mode=Mode.PASSIVE)
    robot.feel(left_m=40.0, right_m=40.0)
    assert robot.read(19) == 32767
    assert robot.read(43) == int(40.0 / 0.000444564) % 65536
    robot.feel(left_m=-0.001, right_m=-0.001)
    assert robot.read(44) == 65536 - 3


@pytest.mark.parametrize(
    ("mode", "senses", "state"),
    [
        (Mode.PASSIVE, {}, 0),
        (Mode.PASSIVE, {"contacts": True, "charging": True, "charge_ah": 3.0}, 2),
        (Mode.PASSIVE, {"contacts": True, "charging": True}, 3),
        (Mode.PASSIVE, {"contacts": True}, 4),
        (Mode.FULL, {"contacts": True, "charging": True}, 0),
    ],
)
def test_charging_states(mode: Mode, senses: dict[str, object], state: int) -> None:
    robot = Robot(mode=mode)
    robot.feel(**senses)
    assert robot.read(21) == state
    assert robot.emulator.may_charge is (mode is Mode.PASSIVE)


def test_buttons_are_felt_while_pressed_and_opcode_165_lets_go_by_itself() -> None:
    robot = Robot(mode=Mode.PASSIVE)
    robot.say(oi.buttons(0x01))
    assert robot.read(18) == 1
    robot.wait(0.2)
    assert robot.read(18) == 0
    robot.emulator.press(0x08)
    robot.wait(5)
    assert robot.read(18) == 8


# Streams


@both
def test_a_stream_sends_a_valid_frame_every_15_ms(model: Model) -> None:
    robot = Robot(model, Mode.PASSIVE)
    robot.say(oi.stream((7, 19, 35)))
    heard = robot.wait(0.3)
    decoder = StreamDecoder(model, (7, 19, 35))
    assert decoder.feed(heard) == [{7: 0, 19: 0, 35: 1}] * 20
    assert decoder.skipped_bytes == 0


def test_a_stream_pauses_resumes_and_ends() -> None:
    robot = Robot(mode=Mode.PASSIVE)
    robot.say(oi.stream((35,)), oi.stream_switch(False))
    assert robot.wait(0.1) == b""
    robot.say(oi.stream_switch(True))
    assert robot.wait(0.031) == bytes.fromhex("13 02 23 01 c7") * 2
    assert robot.emulator.streamed_packets == 1
    robot.say(oi.stream(()))
    assert robot.wait(0.1) == b""
    robot.say(oi.stream_switch(True))
    assert robot.wait(0.1) == b""


def test_a_late_step_sends_one_frame_not_a_burst() -> None:
    robot = Robot(mode=Mode.PASSIVE)
    robot.say(oi.stream((35,)))
    assert len(robot.wait(1.0, step_s=0.5)) == 2 * 5


def test_a_frame_that_the_baud_rate_cannot_carry_in_a_tick_takes_longer() -> None:
    robot = Robot(Model.CREATE2, Mode.PASSIVE)
    robot.say(oi.baud(9600), oi.stream((100,)))
    frames = len(robot.wait(3.0)) // (80 + 1 + 3)
    assert frames == int(3.0 / 0.09)


def test_stopping_ends_the_stream() -> None:
    robot = Robot(mode=Mode.FULL)
    robot.say(oi.stream((35,)))
    robot.wait(0.1)
    robot.say(Op.STOP)
    assert robot.wait(0.1) == b""


# Songs, lights, outputs


def test_a_song_plays_its_real_duration_and_is_not_interrupted() -> None:
    robot = Robot(mode=Mode.FULL)
    robot.say(oi.song(1, [(60, 32), (62, 32)]), oi.song(2, [(60, 64)]), oi.play(1))
    robot.wait(0.5)
    robot.say(oi.play(2))
    assert (robot.read(36), robot.read(37)) == (1, 1)
    robot.wait(0.5)
    assert robot.read(37) == 0
    robot.say(oi.play(3))
    assert robot.read(37) == 0


def test_lights_and_outputs_are_latched_where_actuators_are_allowed() -> None:
    robot = Robot(Model.CREATE1, Mode.PASSIVE)
    robot.say(oi.leds(2, 255, 128), oi.digital_outputs(5))
    assert robot.emulator.leds == (0, 0, 0)
    robot.say(Op.FULL, oi.leds(2, 255, 128), oi.digital_outputs(5))
    assert robot.emulator.leds == (2, 255, 128)
    assert robot.emulator.outputs == {"digital_outputs": (5,)}


# Scripts (Create 1)


def scripted(commands: bytes, mode: Mode = Mode.FULL) -> Robot:
    robot = Robot(Model.CREATE1, mode)
    robot.say(oi.script(commands), Op.PLAY_SCRIPT)
    return robot


def test_a_script_is_shown_as_it_was_stored_and_halts_the_stream() -> None:
    robot = Robot(Model.CREATE1, Mode.PASSIVE)
    robot.say(oi.stream((35,)), oi.script(b"\x9b\x0a"), Op.SHOW_SCRIPT)
    assert robot.wait(0.1) == b"\x02\x9b\x0a"


def test_a_script_drives_waits_and_stops_and_hears_nobody_meanwhile() -> None:
    robot = scripted(oi.drive_direct(100, 100) + oi.wait_time(10) + oi.drive_direct(0, 0))
    robot.wait(0.5)
    assert robot.body.wheels == (0.1, 0.1)
    robot.say(oi.drive_direct(300, 300))
    assert robot.ask(oi.sensors(35)) == b""
    robot.wait(0.6)
    assert robot.body.wheels == (0.0, 0.0)
    assert robot.read(35) == 3


@pytest.mark.parametrize(
    ("wait", "senses"),
    [
        (oi.wait_distance(200), {"left_m": 0.21, "right_m": 0.21}),
        (oi.wait_distance(-200), {"left_m": -0.21, "right_m": -0.21}),
        (oi.wait_angle(90), {"left_m": -0.21, "right_m": 0.21}),
        (oi.wait_angle(-90), {"left_m": 0.21, "right_m": -0.21}),
        (oi.wait_event(5), {"bump_left": True}),
        (oi.wait_event(10), {"cliff_right": True}),
        (oi.wait_event(15), {"contacts": True}),
        (oi.wait_event(-9), {"wall": False}),
    ],
)
def test_a_wait_ends_when_what_it_waits_for_happens(wait: bytes, senses: dict[str, object]) -> None:
    robot = Robot(Model.CREATE1, Mode.FULL)
    robot.feel(wall=True)
    robot.say(oi.script(wait + oi.drive_direct(100, 100)), Op.PLAY_SCRIPT)
    robot.wait(1.0)
    assert robot.body.wheels == (0.0, 0.0)
    robot.feel(**senses)
    robot.wait(0.05)
    assert robot.body.wheels == (0.1, 0.1)


def test_a_script_that_calls_itself_without_waiting_does_not_hang_the_firmware() -> None:
    robot = scripted(oi.bare(Op.PLAY_SCRIPT))
    robot.wait(0.1)
    assert robot.read(35) == 3


# Seek dock by bytes; the state machine has tests of its own


@both
def test_seek_dock_drives_in_passive_until_something_takes_over(model: Model) -> None:
    for take_over in (oi.bare(Op.START), oi.bare(Op.SAFE), oi.drive(100, 100), oi.drive_direct(0, 0)):
        robot = Robot(model, Mode.FULL)
        robot.feel(ir_red=True, ir_green=True)
        robot.say(Op.SEEK_DOCK)
        robot.wait(0.1)
        assert robot.mode is Mode.PASSIVE
        assert robot.body.wheels[0] == robot.body.wheels[1] > 0.1
        robot.say(take_over)
        robot.wait(0.1)
        assert not robot.emulator.seeking
        assert robot.body.wheels == (0.0, 0.0)


@both
def test_seek_dock_stops_on_the_contacts(model: Model) -> None:
    robot = Robot(model, Mode.PASSIVE)
    robot.feel(ir_red=True, ir_green=True)
    robot.say(Op.SEEK_DOCK)
    robot.wait(0.1)
    robot.feel(contacts=True, charging=True, charge_ah=1.0)
    robot.wait(0.02)
    assert robot.body.wheels == (0.0, 0.0)
    assert not robot.emulator.seeking
    assert robot.read(21) == 2


def test_a_lifted_robot_gives_up_docking() -> None:
    robot = Robot(mode=Mode.PASSIVE)
    robot.say(Op.SEEK_DOCK)
    robot.wait(0.1)
    robot.feel(drop_left=True)
    robot.wait(0.02)
    assert not robot.emulator.seeking


def test_seeking_for_long_does_not_count_as_idle() -> None:
    robot = Robot(mode=Mode.PASSIVE)
    robot.say(Op.SEEK_DOCK)
    robot.wait(301, step_s=0.5)
    assert robot.emulator.seeking


# Links


def test_a_closed_link_stops_nothing() -> None:
    async def main() -> None:
        clock = VirtualClock()
        body = Body()
        host = EmulatorHost(CreateEmulator(Model.CREATE2, body, random.Random(1)), clock)
        running = asyncio.create_task(host.run())
        for _ in range(2):
            here, there = memory_pair(clock)
            host.attach(there)
            here.write(b"\x80\x84" + oi.drive_direct(100, 100))
            await clock.sleep(0.1)
            await here.close()
            await clock.sleep(100)
            assert body.wheels == (0.1, 0.1)
        running.cancel()

    run_virtual(main())


def test_a_stream_longer_than_a_frame_can_tell_is_not_sent() -> None:
    robot = Robot(mode=Mode.SAFE)
    robot.say(oi.stream([100] * 4))
    assert robot.wait(0.1) == b""
    robot.say(oi.stream([7]))
    assert robot.wait(0.1) != b""
