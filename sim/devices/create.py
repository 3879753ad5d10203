"""An iRobot Create's firmware: Open Interface bytes in and out, wheels and senses through a `CreateBody`.

Behaviour that the manuals leave open is listed in `docs/devices/create.md`. It does not stop because a link closed, and
there is no drive watchdog: a setpoint holds until replaced, as on the real one.
"""

from __future__ import annotations

import math
import random
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from hw.protocols.create import (
    BAUD_RATES,
    PWM_MAX,
    SPEED_MMPS_MAX,
    SPIN_LEFT,
    SPIN_RIGHT,
    STRAIGHT,
    STRAIGHT_TOO,
    TICK_S,
    Command,
    CommandParser,
    Mode,
    Model,
    Op,
)
from hw.protocols.create_sensors import CHECKSUM, Layout, frame, members
from sim.devices.create_dock import DockSeeker, Side
from sim.devices.create_script import Scripts
from sim.devices.create_senses import Senses
from sim.devices.create_songs import Songs
from sim.devices.plants import CreateBody, CreateSense

ANSWER_S = 0.005
"""A request is answered this long after it came (a client that flushes its input first needs it)."""
SLEEP_S = 300.0
"""Passive and without a command for so long, the robot sleeps."""
BOOT_S = 5.0
BOOT_TEXT = b"bl-start\r\nemulated create2\r\nbooting: garden\r\n"
ROBOT_RADIUS_MM = 170
COMMANDS_PER_STEP_MAX = 200
"""A script that loops without waiting must not hang the firmware."""
STREAM_BYTES_MAX = 255
"""A frame tells its length in one byte; a stream of more packets than that is not sent."""
_EPS_S = 1e-9
_OFF, _PASSIVE, _SAFE = Mode.OFF, Mode.PASSIVE, Mode.SAFE
"""Asked some hundred times a second; to look a member up in its enum costs as much as all the rest."""


@dataclass(slots=True)
class Motion:
    """What the wheels were told last, as packets 39 to 42 tell it; rim speeds in mm/s."""

    right_mmps: float = 0.0
    left_mmps: float = 0.0
    velocity: int = 0
    radius: int = 0
    direct_right: int = 0
    direct_left: int = 0

    @property
    def forward(self) -> bool:
        return self.left_mmps + self.right_mmps > 0

    @property
    def tight(self) -> bool:
        """Turning about a point within the robot's own radius."""
        return 0 < abs(self.radius) < ROBOT_RADIUS_MM


class CreateEmulator:
    """Fills `sim.devices.plants.Emulator`.

    `may_charge` tells the world whether the firmware lets charge flow at the dock: not in Safe or Full. `red_side` is the
    side, seen by a robot that faces the dock, on which only the red beam is seen. With `carry` the distance and angle
    packets keep the fractions that whole numbers lose; a real one loses them.
    """

    def __init__(
        self,
        model: Model,
        body: CreateBody,
        rng: random.Random,
        *,
        red_side: Side = "left",
        start_mode: Mode = Mode.OFF,
        carry: bool = True,
        wheelbase_m: float | None = None,
        wheel_diameter_m: float | None = None,
    ) -> None:
        self.model, self.mode = model, start_mode
        self._checksum = CHECKSUM[model]
        self._body, self._rng, self._red_side = body, rng, red_side
        self._wheelbase_m = wheelbase_m or (0.258 if model is Model.CREATE1 else 0.235)
        self.songs = Songs(16 if model is Model.CREATE1 else 5)
        self.senses = Senses(
            model, rng, self._wheelbase_m, wheel_diameter_m or (0.066 if model is Model.CREATE1 else 0.072), carry
        )
        self.scripts = Scripts()
        self.motion = Motion()
        self.baud = 57600 if model is Model.CREATE1 else 115200
        self.leds = (0, 0, 0)
        self.outputs: dict[str, tuple[int, ...]] = {}
        """Last data of low-side drivers, PWM, digital outputs, infrared and displays, by opcode name."""
        self._parser = CommandParser(model)
        self._queue: deque[Command] = deque()
        self._answers: deque[tuple[float, Callable[[float], bytes]]] = deque()
        self._out = bytearray()
        self._seeker: DockSeeker | None = None
        self._wheels = (0.0, 0.0)
        self._now_s = 0.0
        self._command_s = 0.0
        self._tick_s = math.inf
        self._deaf_until_s = 0.0
        self._stream_ids: tuple[int, ...] = ()
        self._stream_layout: Layout | None = None
        self._stream_on = False
        self._frame_s = math.inf
        self._frame_every_s = TICK_S
        self._handlers = self._table()

    # What the world sees

    @property
    def may_charge(self) -> bool:
        """Whether charge may flow when the contacts touch; not in Safe or Full."""
        return self.mode in (Mode.OFF, Mode.PASSIVE)

    @property
    def seeking(self) -> bool:
        """Whether the robot drives itself to the dock."""
        return self._seeker is not None

    def press(self, bits: int, for_s: float = math.inf) -> None:
        """Hold buttons down (packet 18's bits)."""
        self.senses.press(bits, self._now_s + for_s)

    # Emulator

    def receive(self, data: bytes, now_s: float) -> None:
        self._now_s = max(self._now_s, now_s)
        if self._now_s < self._deaf_until_s or self.scripts.waiting:
            return
        for command in self._parser.feed(data):
            self._command_s = self._now_s
            self._execute(command)
            if self.scripts.waiting:
                self._parser.reset()
                break
        self._run_queue()

    def step(self, now_s: float) -> None:
        self._now_s = now_s = max(self._now_s, now_s)
        sense: CreateSense | None = None
        while self._answers and self._answers[0][0] <= now_s + _EPS_S:
            self._out += self._answers.popleft()[1](now_s)
        if now_s + _EPS_S >= self._tick_s:
            self._tick_s = _next(self._tick_s, TICK_S, now_s)
            sense = self._body.sense()
            self._tick(sense)
        if now_s + _EPS_S >= self._frame_s:
            self._frame_s = _next(self._frame_s, self._frame_every_s, now_s)
            self._send_frame(sense or self._body.sense(), now_s)
        if self.mode is _PASSIVE and not self.seeking and now_s - self._command_s + _EPS_S >= SLEEP_S:
            self._off()
        self._set_tick()

    def transmit(self) -> bytes:
        data = bytes(self._out)
        self._out.clear()
        return data

    def due_s(self) -> float:
        due_s = min(self._tick_s, self._frame_s)
        if self._answers:
            due_s = min(due_s, self._answers[0][0])
        if self.mode is _PASSIVE and not self.seeking:
            due_s = min(due_s, self._command_s + SLEEP_S)
        return due_s

    # The 15 ms tick: safety, docking, scripts

    def _set_tick(self) -> None:
        """Tick only while something needs it."""
        needed = self.mode is _SAFE or self.seeking or self.scripts.waiting or bool(self._queue)
        if not needed:
            self._tick_s = math.inf
        elif self._tick_s == math.inf:
            self._tick_s = self._now_s + TICK_S

    def _tick(self, sense: CreateSense) -> None:
        if self.mode is _SAFE and self._unsafe(sense):
            self._passive()
        if self._seeker is not None:
            self._seek(self._seeker, sense)
        if self.scripts.waiting and self.scripts.over(self._now_s, sense, self.senses, self.mode):
            self._command_s = self._now_s
        self._run_queue()

    def _unsafe(self, sense: CreateSense) -> bool:
        if sense.drop_left or sense.drop_right or sense.drop_caster or sense.contacts:
            return True
        cliff = sense.cliff_left or sense.cliff_front_left or sense.cliff_front_right or sense.cliff_right
        moving = self._wheels != (0.0, 0.0)
        return cliff and moving and (self.motion.forward or self.motion.tight)

    def _seek(self, seeker: DockSeeker, sense: CreateSense) -> None:
        if sense.drop_left or sense.drop_right:
            self._passive()
            return
        left_mps, right_mps = seeker.update(self._now_s, sense)
        if seeker.done:
            self._passive()
        else:
            self._set_wheels(left_mps, right_mps)

    def _send_frame(self, sense: CreateSense, now_s: float) -> None:
        if self._stream_layout is not None and self._stream_on and self.mode is not _OFF:
            payload = self._stream_layout.pack(self.senses.values(self._stream_layout.packets, sense, self, now_s))
            if len(payload) <= STREAM_BYTES_MAX:
                self._out += frame(payload, self._checksum)

    def _values(self, packets: tuple[int, ...], now_s: float) -> dict[int, int]:
        return self.senses.values(packets, self._body.sense(), self, now_s)

    # Commands

    def _execute(self, command: Command) -> None:
        op = command.op
        if op == Op.RESET:
            self._reset()
        elif self.mode is Mode.OFF:
            if op == Op.START:
                self._passive()
        elif op not in _ACTUATOR_OPS or self.mode in (Mode.SAFE, Mode.FULL):
            if (handler := self._handlers.get(op)) is not None:
                handler(command)
        elif op in _DRIVE_OPS and self.seeking:
            self._passive()
        self._set_tick()

    def _run_queue(self) -> None:
        """Commands of a script, up to its next wait."""
        for _ in range(COMMANDS_PER_STEP_MAX):
            if not self._queue or self.scripts.waiting:
                break
            self._execute(self._queue.popleft())
        self._set_tick()

    def _table(self) -> dict[int, Callable[[Command], None]]:
        table: dict[int, Callable[[Command], None]] = {
            Op.START: lambda _: self._passive(),
            Op.BAUD: self._set_baud,
            Op.CONTROL: lambda _: self._enter(Mode.SAFE),
            Op.SAFE: lambda _: self._enter(Mode.SAFE),
            Op.FULL: lambda _: self._enter(Mode.FULL),
            Op.POWER: lambda _: self._off(),
            Op.SPOT: lambda _: self._passive(),
            Op.COVER: lambda _: self._passive(),
            Op.DEMO_OR_MAX: self._demo,
            Op.DRIVE: self._drive,
            Op.DRIVE_DIRECT: self._drive_direct,
            Op.DRIVE_PWM: self._drive_pwm,
            Op.LEDS: self._set_leds,
            Op.SONG: lambda command: self.songs.define(command.data),
            Op.PLAY: lambda command: self.songs.play(command.data[0], self._now_s),
            Op.SENSORS: lambda command: self._answer((command.data[0],)),
            Op.SEEK_DOCK: lambda _: self._begin_seek(),
            Op.STREAM: self._set_stream,
            Op.QUERY: lambda command: self._answer(tuple(command.data[1:])),
            Op.STREAM_SWITCH: self._switch_stream,
            Op.SCRIPT: lambda command: self.scripts.store(command.data[1:]),
            Op.PLAY_SCRIPT: lambda _: self._play_script(),
            Op.SHOW_SCRIPT: lambda _: self._show_script(),
            Op.BUTTONS: self._push_buttons,
            Op.STOP: lambda _: self._off(),
        }
        for op in (Op.WAIT_TIME, Op.WAIT_DISTANCE, Op.WAIT_ANGLE, Op.WAIT_EVENT):
            table[op] = self._wait
        for op in _LATCHED_OPS:
            table[op] = self._latch
        return table

    def _enter(self, mode: Mode) -> None:
        """Between Safe and Full the setpoint persists; into or out of Passive the wheels stop."""
        if mode is Mode.PASSIVE or self.mode is Mode.PASSIVE:
            self._seeker = None
            self._halt()
        self.mode = mode

    def _passive(self) -> None:
        self._enter(Mode.PASSIVE)
        self._command_s = self._now_s

    def _off(self) -> None:
        """Asleep: only Start wakes it."""
        self._passive()
        self.mode = Mode.OFF
        self._stream_on, self._frame_s = False, math.inf
        self._queue.clear()

    def _reset(self) -> None:
        self._off()
        self._stream_ids, self._stream_layout = (), None
        self._parser.reset()
        self._deaf_until_s = self._now_s + BOOT_S
        self._answers.clear()
        self._answers.append((self._deaf_until_s, lambda _: BOOT_TEXT))

    def _set_baud(self, command: Command) -> None:
        if command.data[0] < len(BAUD_RATES):
            self.baud = BAUD_RATES[command.data[0]]

    def _demo(self, command: Command) -> None:
        """Create 1's demo 1 is Cover and Dock; the others (and Create 2's Max) drive nowhere here."""
        self._passive()
        if command.data == b"\x01":
            self._begin_seek()

    def _push_buttons(self, command: Command) -> None:
        self.senses.press(command.data[0], self._now_s + 1 / 6)
        if command.data[0] & 0x04:
            self._begin_seek()

    def _begin_seek(self) -> None:
        self._passive()
        self._seeker = DockSeeker(self._rng, self._red_side, self._wheelbase_m)

    # Actuators

    def _drive(self, command: Command) -> None:
        velocity, radius = command.int16s()
        velocity = _clip(velocity)
        right = left = float(velocity)
        if radius in (SPIN_LEFT, SPIN_RIGHT):
            right, left = velocity * radius, -velocity * radius
        elif radius not in (0, STRAIGHT, STRAIGHT_TOO):
            share = 500.0 * self._wheelbase_m / radius
            right, left = velocity * (1 + share), velocity * (1 - share)
        self._move(Motion(_clip(right), _clip(left), velocity, radius))

    def _drive_direct(self, command: Command) -> None:
        right, left = (_clip(speed) for speed in command.int16s())
        self._move(Motion(right, left, direct_right=right, direct_left=left))

    def _drive_pwm(self, command: Command) -> None:
        right, left = (max(-PWM_MAX, min(PWM_MAX, duty)) * SPEED_MMPS_MAX / PWM_MAX for duty in command.int16s())
        self._move(Motion(right, left))

    def _move(self, motion: Motion) -> None:
        self.motion = motion
        self._set_wheels(motion.left_mmps / 1000, motion.right_mmps / 1000)

    def _halt(self) -> None:
        self._move(Motion())

    def _set_wheels(self, left_mps: float, right_mps: float) -> None:
        if (left_mps, right_mps) != self._wheels:
            self._wheels = (left_mps, right_mps)
            self._body.set_wheels(left_mps, right_mps)

    def _set_leds(self, command: Command) -> None:
        bits, colour, intensity = command.data
        self.leds = (bits, colour, intensity)

    def _latch(self, command: Command) -> None:
        self.outputs[Op(command.op).name.lower()] = tuple(command.data)

    # Answers and streams

    def _answer(self, ids: tuple[int, ...]) -> None:
        layout = Layout(self.model, ids)
        if layout.packets:
            self._later(lambda now_s: layout.pack(self._values(layout.packets, now_s)))

    def _later(self, make: Callable[[float], bytes]) -> None:
        self._answers.append((self._now_s + ANSWER_S, make))

    def _set_stream(self, command: Command) -> None:
        self._stream_ids = tuple(number for number in command.data[1:] if members(self.model, number))
        self._stream_layout = Layout(self.model, self._stream_ids, with_ids=True) if self._stream_ids else None
        self._run_stream(self._stream_layout is not None)

    def _switch_stream(self, command: Command) -> None:
        self._run_stream(bool(command.data[0] & 1) and self._stream_layout is not None)

    def _run_stream(self, on: bool) -> None:
        if on and self._stream_layout is not None:
            wire_s = (self._stream_layout.size + 3) * 10 / self.baud
            self._frame_every_s = TICK_S * max(1, math.ceil(wire_s / TICK_S))
        if on and not self._stream_on:
            self._frame_s = self._now_s + self._frame_every_s
        elif not on:
            self._frame_s = math.inf
        self._stream_on = on

    @property
    def streamed_packets(self) -> int:
        """Packet 38."""
        return len(self._stream_ids)

    # Scripts (Create 1)

    def _play_script(self) -> None:
        self._queue.clear()
        self._queue.extend(CommandParser(self.model).feed(self.scripts.stored))

    def _show_script(self) -> None:
        self._run_stream(False)
        stored = self.scripts.stored
        self._later(lambda _: bytes([len(stored)]) + stored)

    def _wait(self, command: Command) -> None:
        self.scripts.begin(command, self._now_s, self._body.sense())


_DRIVE_OPS = frozenset({Op.DRIVE, Op.DRIVE_DIRECT, Op.DRIVE_PWM})
_ACTUATOR_OPS = (
    _DRIVE_OPS
    | {Op.MOTORS, Op.LEDS, Op.PLAY, Op.PWM_MOTORS, Op.DIGITAL_OUTPUTS, Op.SEND_IR}
    | {Op.SCHEDULING_LEDS, Op.DIGITS_RAW, Op.DIGITS_ASCII}
)
"""Consumed but ignored in Passive."""
_LATCHED_OPS = (_ACTUATOR_OPS - _DRIVE_OPS - {Op.LEDS, Op.PLAY}) | {Op.SCHEDULE, Op.SET_DAY_TIME}


def _clip(speed: float) -> int:
    return round(max(-SPEED_MMPS_MAX, min(SPEED_MMPS_MAX, speed)))


def _next(last_s: float, every_s: float, now_s: float) -> float:
    """The first multiple after `last_s` that lies ahead of now: late steps skip, they do not burst."""
    return last_s + every_s * (1 + max(0, math.floor((now_s - last_s + _EPS_S) / every_s)))
