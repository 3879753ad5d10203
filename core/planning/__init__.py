"""Getting from here to there: the map, the wavefront planner, the path follower."""

from __future__ import annotations


def warm() -> None:
    """Compile the planner's kernels ahead of need, or load them from numba's cache."""
    from core.planning import wavefront

    wavefront.warm()
