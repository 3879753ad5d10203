"""A Hagisonic StarGazer's firmware: looks up, reports marker poses at its rate, takes commands slowly.

It powers up calculating. A pose leaves `latency_s` after the image it was computed from. A settings session is
CalcStop, writes, SetEnd, then `ParameterUpdate` a while later, then CalcStart.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from typing import Literal

from hw.protocols import stargazer as wire
from sim.devices.outbox import Outbox
from sim.devices.plants import MarkerCamera, MarkerSight

ANSWER_DELAY_S = 0.01
UPDATE_S = 0.3
HEIGHT_CALC_S = 2.0
PARAMETERS = {
    "Version": "2.0100224",
    "IDNum": "1",
    "RefID": "1",
    "HeightFix": "No",
    "MarkHeight": "2500",
    "MarkType": "HLD1L",
    "MarkMode": "Alone",
    "BaudRate": "115200",
}
CHOICES = {
    "HeightFix": ("Yes", "No"),
    "MarkType": ("HLD1S", "HLD1L", "HLD2S", "HLD2L", "HLD3S", "HLD3L"),
    "MarkMode": ("Alone", "Map"),
}
Mode = Literal["map", "multi"]


class StargazerEmulator:
    """Fills `Emulator` over a `MarkerCamera`.

    `mode` chooses the firmware: `map` reports `~^I`, `multi` reports `~^1`, or `~^2` when `also` sees another marker.
    Bytes that follow one another sooner than `byte_gap_s` damage the command, as on the device; 0 forgives everything.
    """

    def __init__(
        self,
        camera: MarkerCamera,
        rng: random.Random,
        rate_hz: float = 2.0,
        mode: Mode = "map",
        *,
        also: MarkerCamera | None = None,
        latency_s: float = 0.06,
        byte_gap_s: float = 0.0,
    ) -> None:
        self._camera, self._also, self._mode = camera, also, mode
        self._period_s, self._latency_s, self._byte_gap_s = 1.0 / rate_hz, latency_s, byte_gap_s
        self._phase_s = rng.uniform(0.0, self._period_s)
        self._reader, self._out = wire.FrameReader(), Outbox()
        self._parameters = dict(PARAMETERS)
        self._calculating = True
        self._kind = "I"
        self._mapped: list[int] = []
        self._look_s: float | None = None
        self._last_byte_s = -math.inf
        self._later: list[tuple[float, Callable[[float], None]]] = []

    def receive(self, data: bytes, now_s: float) -> None:
        self.step(now_s)
        for text in self._reader.feed(self._heard(data, now_s)):
            if (message := wire.parse(text)) is not None:
                self._obey(message, now_s)

    def step(self, now_s: float) -> None:
        if self._later:
            self._run_later(now_s)
        if self._look_s is None:
            self._look_s = now_s + self._phase_s
        if now_s >= self._look_s - 1e-9:
            self._look_s += self._period_s * (1 + max(0, math.floor((now_s - self._look_s) / self._period_s)))
            if self._calculating:
                self._look(now_s)
        self._out.release(now_s)

    def transmit(self) -> bytes:
        return self._out.take()

    def due_s(self) -> float:
        if self._look_s is None:
            return 0.0
        due_s = self._out.due_s()
        if self._calculating and self._look_s < due_s:
            due_s = self._look_s
        return min(due_s, min(item[0] for item in self._later)) if self._later else due_s

    def _heard(self, data: bytes, now_s: float) -> bytes:
        """The bytes as the device's slow receiver takes them: too fast a byte is lost."""
        if self._byte_gap_s <= 0.0:
            return data
        early = now_s - self._last_byte_s < self._byte_gap_s - 1e-9
        self._last_byte_s = now_s
        return b"" if early else data[:1]

    def _run_later(self, now_s: float) -> None:
        due = [item for item in self._later if item[0] <= now_s + 1e-9]
        self._later = [item for item in self._later if item[0] > now_s + 1e-9]
        for _, act in due:
            act(now_s)

    def _look(self, now_s: float) -> None:
        sights = [sight for camera in (self._camera, self._also) if camera and (sight := camera.sight(now_s))]
        self._out.put(self._report(sights, now_s), now_s + self._latency_s)

    def _report(self, sights: list[MarkerSight], now_s: float) -> bytes:
        if not sights:
            return wire.encode(wire.DeadZone())
        views = [_view(sight) for sight in sights]
        if self._kind == "F":
            self._build_map(views[0].marker_id, now_s)
        if self._mode == "multi" and self._kind == "I":
            return wire.encode_poses(str(len(views)), views)
        return wire.encode_poses(self._kind, views[:1])

    def _obey(self, message: wire.Message, now_s: float) -> None:
        match message:
            case wire.Command(name, None):
                self._say(wire.Ack(name), now_s)
                self._act(name, now_s)
            case wire.Command(name, str(value)):
                if self._write(name, value):
                    self._say(wire.Ack(f"{name}|{value}"), now_s)
            case wire.Read(name) if name in self._parameters:
                self._say(wire.Ack(name), now_s)
                self._say(wire.Value(name, self._parameters[name]), now_s)

    def _say(self, message: wire.Ack | wire.Value | wire.Note, now_s: float) -> None:
        self._out.put(wire.encode(message), now_s + ANSWER_DELAY_S)

    def _act(self, name: str, now_s: float) -> None:
        match name:
            case "CalcStop":
                self._calculating = False
            case "CalcStart":
                self._calculating = True
                self._kind = "I" if self._kind == "Z" else self._kind
                self._look_s = now_s + self._period_s
            case "SetEnd":
                self._after(UPDATE_S, now_s)
            case "Reset":
                self._parameters = dict(PARAMETERS)
                self._kind = "I"
                self._after(UPDATE_S, now_s)
            case "HeightCalc":
                self._kind, self._calculating = "Z", True
                self._later.append((now_s + HEIGHT_CALC_S, self._end_height_calc))

    def _after(self, delay_s: float, now_s: float) -> None:
        self._later.append((now_s + delay_s, self._tell_update))

    def _tell_update(self, now_s: float) -> None:
        self._say(wire.Ack("ParameterUpdate"), now_s)

    def _end_height_calc(self, now_s: float) -> None:
        if (sight := self._camera.sight(now_s)) is not None:
            self._parameters["MarkHeight"] = str(round(sight.z_cm * 10.0))
        self._kind = "I"
        self._tell_update(now_s)

    def _write(self, name: str, value: str) -> bool:
        """Whether the setting was taken: nothing is while calculating, nor what the device does not know."""
        if name == "MapMode" and value == "Start":
            self._kind, self._calculating, self._mapped = "F", True, []
            return True
        known = name in self._parameters and name != "Version" and not self._calculating
        if not known or not (value in CHOICES[name] if name in CHOICES else value.isdecimal()):
            return False
        self._parameters[name] = value
        return True

    def _build_map(self, marker_id: int, now_s: float) -> None:
        """Notes each new marker; with the last of `IDNum` the map is saved."""
        if marker_id in self._mapped:
            return
        self._mapped.append(marker_id)
        self._say(wire.Note(f"MAPID|{marker_id}"), now_s)
        if len(self._mapped) >= int(self._parameters["IDNum"]):
            self._kind = "I"
            self._say(wire.Ack("MapDataSave"), now_s)
            self._after(UPDATE_S, now_s)


def _view(sight: MarkerSight) -> wire.MarkerView:
    theta_deg = math.remainder(sight.theta_deg, 360.0)
    return wire.MarkerView(sight.marker_id, theta_deg, sight.x_cm, sight.y_cm, sight.z_cm)
