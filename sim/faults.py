"""Things that go wrong on demand: on wires, in robots, in pots. Each ends by itself or when it is lifted.

What each kind does and which targets it takes is told by `KINDS`; `docs/simulator.md` has the same as a table.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Annotated, Any, Literal

from pydantic import Field

from core.errors import NotFound, Unprocessable
from core.wire.documents import Document, Identifier
from sim.devices.host import EmulatorHost
from sim.physics.water import PumpFault
from sim.pot import ProbeFault
from sim.world import World

Target = Literal["device", "robot", "plant"]
KINDS: dict[str, tuple[Target, float | None, str]] = {
    "serial_noise": ("device", 0.02, "share of bytes, both ways, that are changed or lost (0-1)"),
    "serial_silence": ("device", None, "no byte passes, though the link stays open"),
    "marker_blindness": ("robot", None, "the localizer sees no marker"),
    "wheel_slip": ("robot", 3.0, "factor on the tyres' creep (0-20)"),
    "pump_stuck": ("robot", 0.0, "0: the pump does not start; 1: it does not stop"),
    "dead_battery": ("robot", None, "the pack gives nothing"),
    "force_stuck": ("robot", None, "the gripper's force sensor repeats its last reading"),
    "slippery_grip": ("robot", 0.08, "friction of the finger pads (0-1; they have 1)"),
    "branch_sway": ("plant", 0.02, "how far its trusses swing to and fro [m] (0-0.1)"),
    "camera_silent": ("robot", None, "the hand's camera gives no picture"),
    "camera_frozen": ("robot", None, "the hand's camera repeats its last picture"),
    "camera_black": ("robot", None, "something covers the lens"),
    "camera_overexposed": ("robot", 8.0, "factor on the exposure (1-20)"),
    "camera_upside_down": ("robot", None, "the camera hangs the wrong way up"),
    "soil_stuck": ("plant", None, "the probe repeats its last reading"),
    "soil_open": ("plant", None, "the probe's wire is broken"),
    "soil_short": ("plant", None, "the probe's wire touches the supply"),
}
"""Kind -> what it befalls, its default strength (None: it has none), what strength means or what happens."""
_STRENGTH_MAX = {
    "serial_noise": 1.0,
    "wheel_slip": 20.0,
    "pump_stuck": 1.0,
    "camera_overexposed": 20.0,
    "slippery_grip": 1.0,
    "branch_sway": 0.1,
}
_PROBE = {"soil_stuck": ProbeFault.STUCK, "soil_open": ProbeFault.OPEN, "soil_short": ProbeFault.SHORT}
CAMERA = tuple(kind for kind in KINDS if kind.startswith("camera_"))
FAULTS_MAX = 100


class FaultRequest(Document):
    """`POST /faults`."""

    kind: Identifier
    target: Identifier
    duration_s: Annotated[float, Field(gt=0, le=1e7)] | None = None
    """Garden seconds; without it the fault stays until it is deleted."""
    strength: Annotated[float, Field(ge=0, le=20)] | None = None


class Fault(Document):
    """A fault that is in force."""

    id: str
    kind: str
    target: str
    strength: float | None
    since_s: float
    until_s: float | None


class FaultBoard:
    """All faults in force. Stands among the clockwork's hosts so that it runs when a fault ends."""

    def __init__(self, world: World, wires: Mapping[str, EmulatorHost]) -> None:
        self._world, self._wires = world, wires
        self._faults: dict[str, Fault] = {}
        self._count = 0
        self.on_end: Callable[[Fault], None] = lambda fault: None
        """Called when a fault ends by itself."""

    def pump(self, now_s: float) -> None:
        for fault in [f for f in self._faults.values() if f.until_s is not None and f.until_s <= now_s + 1e-9]:
            self._drop(fault)
            self.on_end(fault)

    def due_s(self) -> float:
        return min((f.until_s for f in self._faults.values() if f.until_s is not None), default=math.inf)

    def all(self) -> list[Fault]:
        return list(self._faults.values())

    def add(self, request: FaultRequest) -> Fault:
        """Bring a fault about; raises Unprocessable that names what is allowed."""
        strength = self._checked(request)
        if len(self._faults) >= FAULTS_MAX:
            raise Unprocessable(f"{FAULTS_MAX} faults are in force already", hint="DELETE /faults/ID lifts one")
        now_s = self._world.time_s
        self._count += 1
        fault = Fault(
            id=f"fault-{self._count}",
            kind=request.kind,
            target=request.target,
            strength=strength,
            since_s=now_s,
            until_s=None if request.duration_s is None else now_s + request.duration_s,
        )
        self._faults[fault.id] = fault
        self._apply(fault.kind, fault.target)
        return fault

    def remove(self, fault_id: str) -> Fault:
        """Lift a fault; raises NotFound."""
        fault = self._faults.get(fault_id)
        if fault is None:
            raise NotFound(f"no fault {fault_id}", hint="GET /faults lists those in force")
        self._drop(fault)
        return fault

    def kept(self) -> list[dict[str, Any]]:
        """The faults in force, for a checkpoint."""
        return [fault.model_dump() for fault in self._faults.values()]

    def restore(self, kept: list[dict[str, Any]]) -> None:
        """Exactly these faults and no others."""
        faults = [Fault.model_validate(entry) for entry in kept]
        self._faults = {fault.id: fault for fault in faults}
        self._count = max((int(fault.id.rpartition("-")[2]) for fault in faults), default=0)
        for kind, (befalls, _, _) in KINDS.items():
            for target in self._targets(befalls):
                self._apply(kind, target)

    def _drop(self, fault: Fault) -> None:
        del self._faults[fault.id]
        self._apply(fault.kind, fault.target)

    def _targets(self, befalls: Target) -> list[str]:
        if befalls == "device":
            return sorted(self._wires)
        return list(self._world.robots if befalls == "robot" else self._world.pots)

    def _checked(self, request: FaultRequest) -> float | None:
        if request.kind not in KINDS:
            raise Unprocessable(f"no fault of the kind {request.kind!r}", hint=f"kinds: {', '.join(KINDS)}")
        befalls, default, meaning = KINDS[request.kind]
        targets = self._targets(befalls)
        if request.target not in targets:
            raise Unprocessable(
                f"{request.kind} cannot befall {request.target!r}", hint=f"it takes a {befalls}: {', '.join(targets)}"
            )
        if request.strength is None:
            return default
        if default is None or request.strength > _STRENGTH_MAX[request.kind]:
            raise Unprocessable(f"{request.kind} does not take the strength {request.strength}", hint=meaning)
        return request.strength

    def _apply(self, kind: str, target: str) -> None:
        """Make the world agree with the faults of this kind that befall this target."""
        befalls = KINDS[kind][0]
        if befalls == "device":
            self._apply_wire(kind, target)
        elif befalls == "robot":
            self._apply_robot(kind, target)
        else:
            self._apply_pot(target)
            self._world.orchard.sway_m[target] = max(self._strengths("branch_sway", target), default=0.0)

    def _strengths(self, kind: str, target: str) -> list[float]:
        return [f.strength or 0.0 for f in self._faults.values() if (f.kind, f.target) == (kind, target)]

    def _apply_wire(self, kind: str, target: str) -> None:
        strengths = self._strengths(kind, target)
        if kind == "serial_noise":
            self._wires[target].noise(max(strengths, default=0.0))
        else:
            self._wires[target].silence(bool(strengths))

    def _apply_robot(self, kind: str, target: str) -> None:
        faults, strengths = self._world.robots[target].faults, self._strengths(kind, target)
        if kind == "marker_blindness":
            faults.marker_blind = bool(strengths)
        elif kind == "dead_battery":
            faults.dead_battery = bool(strengths)
        elif kind == "force_stuck":
            faults.force_stuck = bool(strengths)
        elif kind == "slippery_grip":
            faults.pad_friction = min(strengths, default=None)
        elif kind in CAMERA:
            faults.camera = faults.camera | {kind} if strengths else faults.camera - {kind}
            faults.overexposure = max(self._strengths("camera_overexposed", target), default=1.0)
        elif kind == "wheel_slip":
            faults.wheel_slip = max(strengths, default=1.0)
        elif strengths:
            faults.pump = PumpFault.STUCK_ON if strengths[-1] >= 0.5 else PumpFault.STUCK_OFF
        else:
            faults.pump = PumpFault.OK

    def _apply_pot(self, target: str) -> None:
        in_force = [f.kind for f in self._faults.values() if f.target == target and f.kind in _PROBE]
        self._world.pots[target].probe_fault = _PROBE[in_force[-1]] if in_force else ProbeFault.OK
