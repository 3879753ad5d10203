"""What holds for every test."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import structlog

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture(autouse=True)
def _logs_as_they_were() -> Iterator[None]:
    """Whoever hushes the logs in a test does so for that test alone."""
    yield
    structlog.reset_defaults()
