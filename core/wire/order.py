"""Orders: "N ripe tomatoes", split over the plants; each runs its own auction."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from core.wire.documents import Document, Identifier, Sentence
from core.wire.market import Within

OrderState = Literal["running", "done", "partial", "failed", "cancelled"]


class OrderRequest(Document):
    """`POST /orders` at the console, by an operator."""

    count: Annotated[int, Field(ge=1, le=200)]
    plant_id: Annotated[str, Field(max_length=80)] = ""
    """Only from this plant; any if empty."""
    within_s: Within | None = None
    """The deadline of every part."""
    priority: Annotated[int, Field(ge=0, le=9)] = 5


class OrderPart(Document):
    """What one plant was asked for, and what it has given."""

    plant_id: Identifier
    count: Annotated[int, Field(ge=0)]
    task_id: Annotated[str, Field(max_length=80)] = ""
    """Its harvest task; empty until the plant has taken it."""
    state: Literal["asked", "announced", "awarded", "running", "done", "failed", "cancelled", "silent"] = "asked"
    picked: list[Identifier] = []
    """Fruit ids."""
    robot_id: Annotated[str, Field(max_length=80)] = ""
    phase: Sentence = ""
    reason: Sentence = ""


class Order(Document):
    """`GET /orders/{id}`. `partial`: some fruit came, not all; the reason says why."""

    order_id: Identifier
    count: Annotated[int, Field(ge=1)]
    plant_id: Annotated[str, Field(max_length=80)] = ""
    asked_by: Annotated[str, Field(max_length=80)] = ""
    created_s: float
    updated_s: float
    state: OrderState = "running"
    delivered: Annotated[int, Field(ge=0)] = 0
    parts: list[OrderPart] = []
    ripe_tomorrow: Annotated[float, Field(ge=0)] = 0.0
    """Expected over all plants a day ahead, when the order was split."""
    reason: Sentence = ""
