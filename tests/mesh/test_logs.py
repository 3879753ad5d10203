"""What services write when something breaks."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

SCRIPT = """
import structlog
from core.mesh.runtime import setup_logging
setup_logging("{how}")

def broken(token):
    raise ZeroDivisionError("on purpose")

try:
    broken("a-token-that-opens-everything")
except ZeroDivisionError:
    structlog.get_logger("test").exception("request failed")
"""


@pytest.mark.parametrize("how", ["json", "text"])
def test_a_traceback_in_the_log_names_the_place_and_shows_no_values(how: str) -> None:
    ran = subprocess.run([sys.executable, "-c", SCRIPT.format(how=how)], capture_output=True, text=True, check=True)
    assert "on purpose" in ran.stderr
    assert "broken" in ran.stderr
    assert "a-token" not in ran.stderr
    if how == "json":
        (line,) = ran.stderr.splitlines()
        assert json.loads(line)["exception"][0]["exc_type"] == "ZeroDivisionError"
