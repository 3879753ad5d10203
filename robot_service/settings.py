"""A robot's settings, from the environment with the prefix `ROBOT_`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, field_validator
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict

from core.errors import ConfigError
from core.robots import gardener
from core.robots.garden_map import GardenMap
from core.wire.geometry import Pose2

CAPABILITIES = ("water", "inventory", "harvest", "charge", "refill")
NEED_EYE = ("inventory", "harvest")
"""What a robot without a camera cannot do."""


class RobotSettings(BaseSettings):
    """`ROBOT_ID`, `ROBOT_BODY_URL`, `ROBOT_MAP` (JSON) and `ROBOT_HOME` (JSON) must be given; the rest has defaults."""

    model_config = SettingsConfigDict(env_prefix="ROBOT_", frozen=True, extra="ignore", populate_by_name=True)

    id: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,40}$")]
    url: str = "http://127.0.0.1:8201"
    """Where this robot answers."""
    body_url: str
    """The body's local stream: `unix:///PATH`, `socket://HOST:PORT` or `memory://NAME`."""
    body_secret: str = ""
    body_secret_file: Path | None = None
    create: Literal["create1", "create2"] = "create2"
    wrist: Literal["plain", "roll"] = "plain"
    """`roll`: a fifth servo turns the fingers about the hand's axis."""
    docking: Literal["seek-dock", "beam"] = "seek-dock"
    localisation: Literal["kalman", "exponential"] = "kalman"
    camera_url: str = ""
    """The camera in the hand: `http://HOST/PATH.jpg` or `.mjpg`, `v4l2:/dev/videoN`, `file:PATTERN`. Empty: no camera."""
    detector: Annotated[str, Field(max_length=200)] = "best"
    """How it finds fruit: `filter`, `features`, `best`, or your own `MODULE:FUNCTION`."""
    home: Pose2
    map: GardenMap
    capabilities: Annotated[tuple[str, ...], NoDecode] = CAPABILITIES
    """What it is fitted for, separated by commas in the environment."""
    spread_after_s: Annotated[float, Field(ge=0, le=1e6)] = 120.0
    """Idle for so long, it looks for a better place to wait at; 0: never, it waits where its last work ended."""
    data: Path | None = None
    """Folder for the boot counter; None keeps nothing."""

    @field_validator("capabilities", mode="before")
    @classmethod
    def _split(cls, value: object) -> object:
        return tuple(part.strip() for part in value.split(",") if part.strip()) if isinstance(value, str) else value

    @property
    def wheelbase_m(self) -> float:
        return gardener.WHEELBASE_M[self.create]

    def secret(self) -> str:
        """What proves to the body that we are its brain; raises ConfigError when the file cannot be read."""
        if self.body_secret_file is None:
            return self.body_secret
        try:
            return self.body_secret_file.read_text().strip()
        except OSError as error:
            raise ConfigError(f"cannot read {self.body_secret_file}: {error.strerror}", hint="run `garden init`") from error
