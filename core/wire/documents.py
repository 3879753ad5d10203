"""The base of every document on the wire."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

Identifier = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._:/-]{0,79}$")]
Sentence = Annotated[str, Field(max_length=500)]
Seconds = Annotated[float, Field(ge=0, le=1e7)]
Ratio = Annotated[float, Field(ge=0, le=1)]
Millilitres = Annotated[float, Field(ge=0, le=1e6)]


class Document(BaseModel):
    """Strict and closed: no coercion, no unknown fields, no NaN."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class Problem(Document):
    """RFC 9457 problem details with a hint for the reader."""

    type: str = "about:blank"
    title: str
    status: int
    detail: str = ""
    hint: str = ""
    instance: str = ""


class NodeCard(Document):
    """`GET /` of every service."""

    id: Identifier
    kind: str
    capabilities: list[str] = []
    place: dict[str, Any] = {}
    """A robot's pose, a plant's dock: what a visitor needs to find it."""
    links: dict[str, str] = {}
    version: str = ""


class HistoryEntry(Document):
    """Something that happened, or was decided against, and why."""

    id: int
    t_s: float
    kind: str
    what: Sentence
    task_id: str = ""
    robot_id: str = ""
    data: dict[str, Any] = {}
