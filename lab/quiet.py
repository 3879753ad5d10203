"""Hushing the services while a whole garden runs in this process."""

from __future__ import annotations

import logging

import structlog


def hush() -> None:
    """Only what is critical is logged from now on: an experiment prints its own lines, and what dies is raised."""
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.CRITICAL))
