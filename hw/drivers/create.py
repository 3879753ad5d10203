"""iRobot Create driver: fills `hw.ports.Base` over the Open Interface, for both models.

The base starts and rests in Passive, where nothing moves and charge may flow, and enters Full (or Safe) with the first
setpoint that moves. Full is the default because Safe gives up the wheels at a cliff without saying so; with Full the
body's own gate must watch cliffs and wheel drops. Standing still on a dock's contacts puts it back to Passive, since no
charge flows in Full. What was asked while the link was down is dropped, never replayed: a connection begins with all
wheels stopped.
"""

from __future__ import annotations

import contextlib
import math
from operator import itemgetter

from core.clock import Clock
from hw.drivers.session import LONG_REST_S, Pulse, Session
from hw.links import Opener
from hw.ports import BaseReading, ChargingState
from hw.protocols import create as wire
from hw.protocols.create import Mode, Model, Op
from hw.protocols.create_sensors import Layout, Packet, StreamDecoder, counter_delta, ir_beams

SILENCE_S = 0.5
"""While streaming; at rest three polls may be lost."""
POLL_S = 1.0
SILENCE_RESTING_S = 3.5
LULL_S = 9.0
"""After a long rest it is left alone for so long between polls."""
SETTLE_S = 0.05
BAUD = {Model.CREATE1: 57600, Model.CREATE2: 115200}
BAUD_SETTLE_S = 0.1
"""Between mode changes at connection; the manual asks for 20 ms."""
REFRESH_S = 0.25
"""An unchanged setpoint goes over the wire this often, in case noise ate it."""
MODE_GRACE_S = 0.15
"""The stream shows a new mode within this time."""
SEEK_GRACE_S = 0.4
DOCKED_S = 0.3
"""Standing on the contacts for so long, the base is put to Passive so that charge flows."""
KEEP_AWAKE_S = 60.0
"""A Passive base sleeps after five minutes without a command."""
ROLLING_M = 0.01
"""A wheel that rolls so far after its stop did not get it."""
GAP_MPS_MAX = 0.55
"""Travel over a gap in the readings is believed up to this speed."""
TICKS_PER_TURN = 508.8
FLUSH = bytes(24)
"""Not an opcode: fills up a command that an earlier connection left half sent."""

_COMMON = (7, 8, 9, 10, 11, 12, 13, 17, 21, 22, 23, 24, 25, 26, 34, 35)
PACKETS = {
    Model.CREATE1: (*_COMMON, Packet.DISTANCE_MM, Packet.ANGLE_DEG),
    Model.CREATE2: (*_COMMON, Packet.ENCODER_LEFT, Packet.ENCODER_RIGHT),
}
_CHARGING = {state.value: state for state in ChargingState}
_FAULT = ChargingState.FAULT
_TOLD = itemgetter(*map(int, _COMMON))
_DISTANCE, _ANGLE = int(Packet.DISTANCE_MM), int(Packet.ANGLE_DEG)
_LEFT, _RIGHT = int(Packet.ENCODER_LEFT), int(Packet.ENCODER_RIGHT)
_CREATE1, _PASSIVE, _SAFE, _FULL = Model.CREATE1, Mode.PASSIVE, Mode.SAFE, Mode.FULL


class CreateDriver(Session):
    """A Create 1 or 2 at `url`. `wheelbase_m` turns yaw rates into rim speeds; `wheel_diameter_m` scales encoders.

    `mode` is what it drives in: FULL or SAFE.
    """

    def __init__(
        self,
        url: str,
        model: Model,
        opener: Opener,
        clock: Clock,
        *,
        wheelbase_m: float,
        wheel_diameter_m: float,
        name: str = "create",
        mode: Mode = Mode.FULL,
    ) -> None:
        super().__init__(url, opener, clock, name=name, silence_s=SILENCE_S)
        self._model, self._wheelbase_m, self._active_mode = model, wheelbase_m, mode
        self._m_per_tick = math.pi * wheel_diameter_m / TICKS_PER_TURN
        self._decoder = StreamDecoder(model, PACKETS[model])
        self._answer = Layout(model, PACKETS[model])
        self._answer_bytes = bytearray()
        self._polling = False
        self._reading: BaseReading | None = None
        self._fresh, self._rest_changed = Pulse(), Pulse()
        self._resting = False
        self._resting_since_s = self._asked_s = 0.0
        self._left_m = self._right_m = 0.0
        self._ticks: tuple[int, int] | None = None
        self._mode: Mode | None = None
        """What the base was last told to be; None before the connection's first Start."""
        self._mode_sent_s = -math.inf
        self._again = False
        """Whether this is not the first connection."""
        self._seeking = False
        self._rims = (0, 0)
        """Right and left setpoint on the wire [mm/s]."""
        self._rims_sent_s = self._halted_s = -math.inf
        self._rolled_m = 0.0
        """By either wheel since it should stand."""

    # hw.ports.Base

    @property
    def reading(self) -> BaseReading | None:
        return self._reading

    @property
    def model(self) -> Model:
        return self._model

    @property
    def seeking(self) -> bool:
        """Whether the base was told to dock and nothing has taken over since."""
        return self._seeking

    @property
    def skipped_bytes(self) -> int:
        """Bytes that belonged to no frame: noise on the wire."""
        return self._decoder.skipped_bytes

    async def wait_reading(self) -> BaseReading:
        """The next reading, as it arrives."""
        while True:
            await self._fresh.wait()
            if self._reading is not None:
                return self._reading

    def drive(self, v_mps: float, omega_radps: float) -> None:
        """Beyond 0.5 m/s at a rim both rims are scaled down alike. Ignored while the link is down.

        Raises ValueError for numbers that are not finite.
        """
        rims = self._rims_of(v_mps, omega_radps)
        if not self._status.up or self._mode is None:
            return
        if rims == (0, 0):
            self._halt(again=False)
        else:
            self._activate()
            self._send_rims(rims, again=False)

    def stop(self) -> None:
        """Stand still, and end a seek; written to the wire whatever was written before."""
        self._halt(again=True)

    def seek_dock(self) -> None:
        """Repeating it changes nothing, unless the base seems not to have heard."""
        if not self._status.up or self._reading is None or self._reading.home_base:
            return
        heard = self._reading.oi_mode == Mode.PASSIVE or self._clock.now() - self._mode_sent_s < SEEK_GRACE_S
        if self._seeking and heard:
            return
        self._seeking, self._rims = True, (0, 0)
        self._tell_mode(Mode.PASSIVE, Op.SEEK_DOCK)

    def rest(self, resting: bool) -> None:
        if resting is self._resting:
            return
        self._resting, self._resting_since_s = resting, self._clock.now()
        self.silence_s = SILENCE_RESTING_S if resting else SILENCE_S
        self._heard_s = self._clock.now()
        self._rest_changed.fire()

    # Setpoints

    def _rims_of(self, v_mps: float, omega_radps: float) -> tuple[int, int]:
        """Right and left rim speeds [mm/s], curvature kept."""
        if not (math.isfinite(v_mps) and math.isfinite(omega_radps)):
            raise ValueError(f"cannot drive at ({v_mps}, {omega_radps})")
        half = 0.5 * omega_radps * self._wheelbase_m
        right, left = 1000.0 * (v_mps + half), 1000.0 * (v_mps - half)
        scale = min(1.0, wire.SPEED_MMPS_MAX / max(abs(right), abs(left), 1e-9))
        return round(right * scale), round(left * scale)

    def _activate(self) -> None:
        """Take the wheels, if the base is not ours already or has dropped out of our mode."""
        self._seeking = False
        now_s = self._clock.now()
        seen = self._reading.oi_mode if self._reading is not None else -1
        mode = self._driving_mode()
        dropped = seen != mode and now_s - self._mode_sent_s > MODE_GRACE_S
        if self._mode is not mode or dropped:
            self._rims_sent_s = -math.inf
            self._tell_mode(mode, Op.FULL if mode is Mode.FULL else Op.SAFE)

    def _driving_mode(self) -> Mode:
        """Safe lets the base itself stop at an edge, even with a dead wire; only Full can leave a dock's live contacts."""
        on_contacts = self._reading is not None and self._reading.home_base
        return Mode.FULL if on_contacts else self._active_mode

    def _tell_mode(self, mode: Mode, op: Op) -> None:
        if self._send(wire.bare(op)):
            self._mode, self._mode_sent_s = mode, self._clock.now()

    def _halt(self, *, again: bool) -> None:
        """Zero rims in our mode, Start in Passive when something may be moving."""
        if self._mode in (_SAFE, _FULL):
            self._send_rims((0, 0), again=again)
        elif self._seeking or again:
            self._seeking = False
            self._tell_mode(Mode.PASSIVE, Op.START)

    def _send_rims(self, rims: tuple[int, int], *, again: bool) -> None:
        now_s = self._clock.now()
        if rims == self._rims and now_s - self._rims_sent_s < REFRESH_S and not again:
            return
        if rims == (0, 0) and self._rims != (0, 0):
            self._halted_s = now_s
        self._rims = rims
        if self._send(wire.drive_direct(*rims)):
            self._rims_sent_s = now_s

    # Session

    async def _converse(self) -> None:
        self._send(FLUSH + wire.bare(Op.START))
        if self._again:
            # Noise can say "another baud rate": a base that went silent is told its own again.
            self._send(wire.baud(BAUD[self._model]))
            await self._clock.sleep(BAUD_SETTLE_S)
        self._again = True
        await self._clock.sleep(SETTLE_S)
        self._send(wire.drive_direct(0, 0) + wire.bare(Op.START))
        self._mode, self._mode_sent_s = Mode.PASSIVE, self._clock.now()
        await self._clock.sleep(SETTLE_S)
        while True:
            if self._resting:
                await self._poll()
                await self._until_rest_changes(POLL_S)
                if self._settled():
                    self.silence_s = SILENCE_RESTING_S + LULL_S
                    await self._until_rest_changes(LULL_S)
            else:
                self._polling = False
                self._send(wire.stream(PACKETS[self._model]))
                await self._until_rest_changes(KEEP_AWAKE_S)

    def _settled(self) -> bool:
        """Resting for long, and the last poll was answered."""
        long = self._clock.now() - self._resting_since_s > LONG_REST_S
        return self._resting and long and self._heard_s >= self._asked_s

    async def _until_rest_changes(self, seconds: float) -> None:
        with contextlib.suppress(TimeoutError):
            async with self._clock.timeout(seconds):
                await self._rest_changed.wait()

    async def _poll(self) -> None:
        """Pause the stream (it may have missed it) and ask once."""
        if not self._polling:
            self._send(wire.stream_switch(False))
            await self._clock.sleep(SETTLE_S)
        self._polling, self._asked_s = True, self._clock.now()
        self._answer_bytes.clear()
        self._send(wire.stream_switch(False) + wire.query(PACKETS[self._model]))

    def _received(self, data: bytes) -> None:
        for values in self._decoder.feed(data):
            self._take(values)
        if self._polling:
            self._answer_bytes += data
            if len(self._answer_bytes) == self._answer.size:
                values = self._answer.unpack(bytes(self._answer_bytes)) or {}
                if _sane(values):
                    self._take(values)

    def _gone(self) -> None:
        self._decoder.reset()
        self._mode, self._seeking, self._polling = None, False, False
        self._rims, self._rims_sent_s = (0, 0), -math.inf

    def _farewell(self) -> bytes:
        return wire.drive_direct(0, 0) + wire.bare(Op.START) + wire.stream_switch(False)

    # Readings

    def _take(self, values: dict[int, int]) -> None:
        now_s = self._clock.now()
        left_m, right_m = self._travelled(values, now_s)
        self._left_m += left_m
        self._right_m += right_m
        self._reading = self._read(values, now_s)
        self._heard()
        self._care(max(abs(left_m), abs(right_m)), now_s)
        self._fresh.fire()

    def _travelled(self, values: dict[int, int], now_s: float) -> tuple[float, float]:
        """Left and right travel [m] since the last reading; what no wheel can have done is dropped."""
        first = self._reading is None
        if self._model is _CREATE1:
            mean_m = values[_DISTANCE] / 1000.0
            half_m = 0.5 * self._wheelbase_m * math.radians(values[_ANGLE])
            left_m, right_m = mean_m - half_m, mean_m + half_m
        else:
            ticks = (values[_LEFT], values[_RIGHT])
            before = self._ticks or ticks
            left_m = counter_delta(ticks[0], before[0]) * self._m_per_tick
            right_m = counter_delta(ticks[1], before[1]) * self._m_per_tick
            self._ticks = ticks
        gap_s = now_s - self._reading.stamp_s if self._reading is not None else 0.0
        credible = max(abs(left_m), abs(right_m)) <= GAP_MPS_MAX * gap_s + 0.05
        return (left_m, right_m) if credible and not first else (0.0, 0.0)

    def _read(self, values: dict[int, int], now_s: float) -> BaseReading:
        (bumps, wall, left, front_left, front_right, right, virtual_wall, ir, charging, mv, ma, celsius, mah, capacity_mah,
         sources, oi_mode) = _TOLD(values)  # fmt: skip
        beams = ir_beams(ir)
        return BaseReading(
            stamp_s=now_s,
            left_m=self._left_m,
            right_m=self._right_m,
            bump_right=bool(bumps & 1),
            bump_left=bool(bumps & 2),
            drop_right=bool(bumps & 4),
            drop_left=bool(bumps & 8),
            drop_caster=bool(bumps & 16),
            wall=bool(wall),
            cliff_left=bool(left),
            cliff_front_left=bool(front_left),
            cliff_front_right=bool(front_right),
            cliff_right=bool(right),
            virtual_wall=bool(virtual_wall),
            ir_red=beams.red,
            ir_green=beams.green,
            ir_field=beams.field,
            oi_mode=oi_mode,
            charging=_CHARGING.get(charging, _FAULT),
            home_base=bool(sources & 2),
            voltage_v=mv / 1000.0,
            current_a=ma / 1000.0,
            charge_ah=mah / 1000.0,
            capacity_ah=capacity_mah / 1000.0,
            battery_temperature_c=float(celsius),
        )

    def _care(self, moved_m: float, now_s: float) -> None:
        """What the driver does by itself after a reading: repeat what got lost, let a docked base charge."""
        reading = self._reading
        if reading is None or self._mode is None:
            return
        if self._seeking:
            self._seeking = not reading.home_base
        said_s = max(self._mode_sent_s, self._rims_sent_s)
        if self._seeking or self._rims != (0, 0) or now_s - said_s < REFRESH_S:
            self._rolled_m = 0.0
            return
        self._rolled_m += moved_m
        rolling = self._rolled_m > ROLLING_M
        if self._mode is _PASSIVE:
            if rolling or reading.oi_mode != _PASSIVE:
                self._tell_mode(Mode.PASSIVE, Op.START)
        elif rolling:
            self._send_rims((0, 0), again=True)
        elif reading.home_base and now_s - self._halted_s > DOCKED_S:
            self._tell_mode(Mode.PASSIVE, Op.START)


def _sane(values: dict[int, int]) -> bool:
    """An answer without a checksum is believed only if every bit could be true."""
    flags = all(values.get(number, 2) <= 1 for number in range(Packet.WALL, Packet.OVERCURRENTS))
    return (
        flags
        and values[Packet.BUMPS_DROPS] <= 31
        and values[Packet.CHARGING_STATE] <= ChargingState.FAULT.value
        and values[Packet.CHARGING_SOURCES] <= 3
        and values[Packet.VOLTAGE_MV] >= 3000
        and values[Packet.CAPACITY_MAH] > 0
        and values[Packet.CHARGE_MAH] <= values[Packet.CAPACITY_MAH] + 500
    )
