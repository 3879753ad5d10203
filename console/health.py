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
    connection = _connection(int(port))
    try:
        connection.request("GET", "/readyz")
        answer = connection.getresponse()
        if answer.status != 200:
            sys.exit(answer.read(2000).decode(errors="replace"))
    except (OSError, http.client.HTTPException) as error:
        sys.exit(f"not reachable: {error}")
    finally:
        connection.close()


def _connection(port: int) -> http.client.HTTPConnection:
    if os.environ.get("GARDEN_TLS", "").lower() not in ("true", "1", "yes", "on"):
        return http.client.HTTPConnection("127.0.0.1", port, timeout=3)
    import ssl

    ours = ssl.create_default_context(cafile=os.path.join(os.environ.get("GARDEN_KEYS", ""), "ca.crt"))
    return http.client.HTTPSConnection("127.0.0.1", port, timeout=3, context=ours)


if __name__ == "__main__":
    main()
