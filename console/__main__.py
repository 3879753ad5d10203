"""`python -m console`: the console's service. The `garden` command is `console.cli`."""

from __future__ import annotations

from console.service import build
from core.mesh.runtime import run

if __name__ == "__main__":
    run(build)
