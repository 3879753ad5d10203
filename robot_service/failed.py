"""How a skill says that it could not."""

from __future__ import annotations

from core.errors import Refused


class SkillFailed(Refused):
    """A job could not be done; the message is the reason given to the plant."""
