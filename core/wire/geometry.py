"""Poses as they cross the wire."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

Metres = Annotated[float, Field(ge=-1000, le=1000)]
Radians = Annotated[float, Field(ge=-1000, le=1000)]


class Point2(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    x_m: Metres
    y_m: Metres


class Pose2(Point2):
    """Planar pose in the world frame; yaw counter-clockwise from x."""

    yaw_rad: Radians


class Point3(Point2):
    z_m: Metres
