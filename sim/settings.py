"""What the world's process is told by its environment, beside the `GARDEN_...` settings all services share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field, ValidationError
from pydantic_settings import BaseSettings, SettingsConfigDict

from core.errors import ConfigError


class SimSettings(BaseSettings):
    """Read from `SIM_...` variables; the port and the address are `GARDEN_PORT` and `GARDEN_HOST`."""

    model_config = SettingsConfigDict(env_prefix="SIM_", frozen=True)

    scenario: str = "garden"
    """A built-in scenario's name, or a path."""
    seed: Annotated[int, Field(ge=0, lt=2**32)] | None = None
    """Instead of the scenario's."""
    speed: Annotated[float, Field(gt=0, le=100)] | None = None
    """Garden seconds a second; instead of the scenario's."""
    data: Path | None = None
    """Where checkpoints go; without it none are made."""
    fresh: bool = False
    """Begin anew although there is a checkpoint."""


def read() -> SimSettings:
    """From the environment; raises ConfigError that names every wrong variable."""
    try:
        return SimSettings()
    except ValidationError as error:
        wrong = (f"SIM_{str(item['loc'][0]).upper()}: {item['msg']}" for item in error.errors() if item["loc"])
        raise ConfigError("; ".join(wrong), hint="docs/simulator.md lists what there is") from error
