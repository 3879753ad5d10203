"""HTTP between the garden's services: chassis, tokens, peers, client, runtime."""

from __future__ import annotations

import sys


def _import_structlog_alone() -> None:
    """structlog draws tracebacks with rich where it finds it; services never do, and rich is a tenth of their start."""
    if "structlog" in sys.modules or "rich" in sys.modules:
        return
    sys.modules["rich"] = None  # type: ignore[assignment]
    try:
        import structlog  # noqa: F401
    finally:
        del sys.modules["rich"]


_import_structlog_alone()
