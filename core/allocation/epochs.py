"""Names that never repeat: task and permit ids carry the plant and its boot counter, epochs only grow.

The boot counter is made durable before anything of that boot leaves the plant, so a counter within the boot needs no disk.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(slots=True)
class Names:
    """Ids of one plant in one boot: `plant-1:3:17`."""

    plant_id: str
    boot: int
    used: int = 0

    def next(self, prefix: str = "") -> str:
        self.used += 1
        return f"{self.plant_id}:{self.boot}:{prefix}{self.used}"


def owner_of(task_id: str) -> str:
    """The plant that gave a task its id; empty when it is not such an id."""
    plant_id, _, rest = task_id.partition(":")
    boot, _, number = rest.partition(":")
    return plant_id if boot.isdigit() and number.isalnum() else ""
