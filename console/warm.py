"""`python -m console.warm`: compile every cached kernel once, so that no bid ever waits for a compiler.

Folders bring theirs by the entry point group `garden.warm`, each a function without arguments.
"""

from __future__ import annotations

import sys
import time
from importlib.metadata import entry_points

GROUP = "garden.warm"


def main() -> None:
    """Call every registered function; a broken one ends with its error, since a cold cache would hide until a bid."""
    for point in sorted(entry_points(group=GROUP), key=lambda point: point.name):
        began_s = time.perf_counter()
        point.load()()
        print(f"{point.name}: compiled in {time.perf_counter() - began_s:.1f} s", file=sys.stderr)


if __name__ == "__main__":
    main()
