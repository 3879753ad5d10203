"""What holds for every test."""

from collections.abc import Iterator

import pytest
import structlog


@pytest.fixture(autouse=True)
def _logs_as_they_were() -> Iterator[None]:
    """Whoever hushes the logs in a test does so for that test alone."""
    yield
    structlog.reset_defaults()
