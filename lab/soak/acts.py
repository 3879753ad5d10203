"""What pumps, hands and wheels do (I1, I2, I3, I8): judged by the truth and by the permits that left the plants."""

from __future__ import annotations

import asyncio
import json
from dataclasses import replace

from core.allocation.permits import DAY_S
from core.allocation.plant_state import Limits
from core.mesh.client import Answer
from core.wire.body import COMMAND_LIFE_S
from lab.soak.case import Case, Given
from lab.soak.garden import COARSE
from lab.soak.net import Message
from lab.soak.world import Dose

SKEW = 1.0005
"""Clocks differ by so much at most."""
STOP_S = COMMAND_LIFE_S + COARSE["robot_service.body.body"]["DT_S"] + 0.05
"""A robot stands so soon after its brain fell silent: a command's life and one turn of the body's loop."""
OVER_RATIO = 1.02
"""A pump gives so much more than its calibration says."""
BEGIN_S = 1.0
"""A pump may begin so long after its permit ran out: the body's turn and the way to it."""


class Acts:
    """Every act is judged when it begins or ends."""

    def __init__(self, case: Case) -> None:
        self._case, self._truth = case, case.truth
        self._limits = Limits()
        self._last: dict[str, Given] = {}
        """The newest permit to water, by plant."""

    # Wheels

    def moved(self, robot_id: str) -> None:
        """I8: a base was told to move."""
        if robot_id in self._case.stopped:
            self._case.breach("I8", f"{robot_id} was driven while its e-stop is latched")

    def halted(self, robot_id: str) -> None:
        """I8: a brain just died or sleeps; look when the last command's life is over."""
        before = self._case.garden.running.get(robot_id)
        asyncio.get_running_loop().call_later(STOP_S, self._stands, robot_id, before)

    def _stands(self, robot_id: str, before: object) -> None:
        now = self._case.garden.running.get(robot_id)
        awake = now is not None and (now is not before or not now.life.stopped)
        body = self._truth.look(robot_id)
        if not awake and (body.moving or body.pumping is not None):
            self._case.breach("I8", f"{robot_id} still moves or pumps {STOP_S:.2f} s after its brain fell silent")

    # Pumps

    def began(self, dose: Dose) -> None:
        """I1, I2: a pump starts."""
        case, held = self._case, self._case.permits.get(dose.permit_id)
        if dose.robot_id in case.stopped:
            case.breach("I8", f"{dose.robot_id} pumps while its e-stop is latched")
        if held is None:
            return case.breach("I2", f"{dose.robot_id} pumps at {dose.plant_id} under no permit that was given")
        if held.robot_id != dose.robot_id or held.plant_id != dose.plant_id:
            case.breach("I1", f"{dose.robot_id} pumps at {dose.plant_id} under {held.robot_id}'s permit {held.permit_id}")
        earlier = self._truth.doses[: dose.number]
        late_s = dose.began_s - held.until_s
        if late_s > BEGIN_S and not any(d.permit_id == dose.permit_id for d in earlier):
            case.breach("I2", f"{dose.robot_id} began {late_s:.1f} s after permit {held.permit_id} had run out")
        for other in self._truth.doses[-8:]:
            if other.ended_s is None and other.number != dose.number and other.plant_id == dose.plant_id:
                case.breach("I1", f"{dose.robot_id} and {other.robot_id} pump at {dose.plant_id} at once")
        before = next((d for d in reversed(earlier) if d.plant_id == dose.plant_id and d.ml > 1.0), None)
        if before is not None and before.permit_id != dose.permit_id and not self._measured(before.ended_s, held):
            case.breach("I2", f"second dose at {dose.plant_id} ({held.permit_id}) without a measurement after the first")

    def _measured(self, since_s: float | None, held: Given) -> bool:
        """Whether the pot looked at its soil between the end of an act, once soaked in, and the next permit."""
        if since_s is None:
            return False
        soaked_s = since_s + self._limits.soak_s / SKEW - 0.5
        return any(soaked_s <= at_s <= held.issued_s for at_s in self._truth.pots[held.plant_id].samples_s)

    def ended(self, dose: Dose) -> None:
        """I2: how much has flowed."""
        held = self._case.permits.get(dose.permit_id)
        ml = sum(d.ml for d in self._truth.doses[-60:] if d.permit_id == dose.permit_id)
        if held is not None and ml > held.dose_ml * OVER_RATIO + 2.0:
            self._case.breach("I2", f"{ml:.0f} ml flowed under permit {held.permit_id} for {held.dose_ml:.0f} ml")
        day_ml = 0.0
        for flowed in reversed(self._truth.doses):
            if flowed.began_s <= self._truth.now() - DAY_S / SKEW:
                break
            day_ml += flowed.ml if flowed.plant_id == dose.plant_id else 0.0
        if day_ml > self._limits.day_cap_ml * OVER_RATIO:
            self._case.breach("I2", f"{day_ml:.0f} ml flowed into {dose.plant_id} within a day")

    # Hands

    def picked(self, robot_id: str, permit_id: str) -> None:
        """I1, I3: a hand has closed."""
        held = self._case.permits.get(permit_id)
        if held is None or held.robot_id != robot_id:
            return self._case.breach("I1", f"{robot_id} picks under a permit that is not its own: {permit_id}")
        for fruit in self._truth.pots[held.plant_id].fruits[-60:]:
            if len(fruit.taken_by) > 1 and fruit.taken_by[-1] == permit_id:
                takers = ", ".join(fruit.taken_by)
                self._case.breach("I3", f"{robot_id} closed its hand where {fruit.name} was already taken ({takers})")

    # Permits

    def given(self, message: Message, answer: Answer) -> None:
        """I1, I2: a permit leaves its plant."""
        case, said, now_s = self._case, json.loads(answer.body), self._truth.now()
        life, until_s = case.garden.running[message.target].life, now_s + said["valid_for_s"] * SKEW
        if (known := case.permits.get(said["permit_id"])) is not None:
            if known.life is not life and said["valid_for_s"] > 0.0:
                # A plant that was started anew does not know how long ago it gave it: its whole time counts anew.
                case.permits[known.permit_id] = replace(known, until_s=until_s, life=life)
            return
        epoch = max((e for task_id, e in case.awards if task_id == said["task_id"]), default=-1)
        holder = case.awards.get((said["task_id"], epoch), "nobody")
        if said["epoch"] < epoch or holder != message.source:
            case.breach("I1", f"{said['task_id']} is {holder}'s, epoch {epoch}, and {message.source} got a permit")
        permit = Given(
            said["permit_id"], said["task_id"], message.source, message.target, said["act"], said["epoch"], said["dose_ml"],
            now_s, until_s, life,
        )  # fmt: skip
        case.permits[permit.permit_id] = permit
        if permit.act != "water":
            return
        before, self._last[permit.plant_id] = self._last.get(permit.plant_id), permit
        if before is not None and not self._measured(before.issued_s, permit):
            case.breach("I2", f"{permit.plant_id} gave {permit.permit_id} without a measurement after {before.permit_id}")

    def settled(self, permit_id: str) -> None:
        """I2: a plant has closed a permit to water; only a measurement may, taken when a dose must have soaked in."""
        if (held := self._case.permits.get(permit_id)) is None:
            return
        soaked_s = held.until_s + self._limits.soak_s / SKEW - 1.0
        if not any(at_s >= soaked_s for at_s in self._truth.pots[held.plant_id].samples_s):
            self._case.breach("I2", f"{held.plant_id} closed permit {permit_id} without a measurement after it")
