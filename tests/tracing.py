"""Whether tests may let system calls of a process fail here."""

from __future__ import annotations

import shutil
import subprocess


def untraceable() -> str:
    """Why a process cannot be traced here; empty when it can."""
    if shutil.which("strace") is None:
        return "strace is not installed: make debian"
    tried = subprocess.run(["strace", "-o", "/dev/null", "true"], capture_output=True, text=True, check=False)
    return "" if tried.returncode == 0 else f"strace may not trace here: {tried.stderr.strip()[:100]}"
