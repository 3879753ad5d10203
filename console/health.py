"""`python -m console.health`: a container's health check. Imports next to nothing, since it runs for ever."""

from __future__ import annotations

import http.client
import os
import sys


def main() -> None:
    """Exit 0 when the service on `GARDEN_PORT` says it is ready, else 1 with the reason."""
    port = os.environ.get("GARDEN_PORT", "")
    if not port.isdigit():
        sys.exit("GARDEN_PORT is not set")
    try:
        connection = http.client.HTTPConnection("127.0.0.1", int(port), timeout=3)
        connection.request("GET", "/readyz")
        answer = connection.getresponse()
        if answer.status != 200:
            sys.exit(answer.read(2000).decode(errors="replace"))
    except OSError as error:
        sys.exit(f"not reachable: {error}")


if __name__ == "__main__":
    main()
