"""The body's settings, from the environment with the prefix `BODY_`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field
from pydantic_settings import BaseSettings, SettingsConfigDict

from core.errors import ConfigError
from core.robots.fence import Fence
from robot_service.body.caps import Caps

SECRET_CHARS_MIN = 16
Url = Annotated[str, Field(pattern=r"^(/dev/\S+|serial://\S+|socket://\S+:\d+|unix:///\S+|memory://\S+)$")]


class BodySettings(BaseSettings):
    """Device URLs say what is meant: a real port or an emulator's. Nothing has a default that could move something."""

    model_config = SettingsConfigDict(env_prefix="BODY_", env_nested_delimiter="__", frozen=True, extra="forbid")

    id: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,40}$")]
    create: Literal["create1", "create2"] = "create2"
    base_url: Url
    servo_url: Url
    marker_url: Url
    listen: Annotated[str, Field(pattern=r"^(unix:///\S+|socket://\S+:\d+|memory://\S+)$")]
    """Where the brain connects: the same URL as the brain's `ROBOT_BODY_URL`."""
    data: Path
    """Folder of the dose ledger and the stop latch."""
    secret_file: Path | None = None
    secret: str = ""
    caps: Caps = Caps()
    fence: Fence | None = None
    """Where the wheels may take it, as far as ceiling markers tell."""

    def shared_secret(self) -> str:
        """What a brain must say first; raises ConfigError when there is none worth the name."""
        secret = self.secret
        if self.secret_file is not None:
            try:
                secret = self.secret_file.read_text().strip()
            except OSError as error:
                raise ConfigError(f"cannot read {self.secret_file}: {error.strerror}", hint="run `garden init`") from error
        if len(secret) < SECRET_CHARS_MIN:
            raise ConfigError(f"the body's secret has fewer than {SECRET_CHARS_MIN} characters", hint="run `garden init`")
        return secret
