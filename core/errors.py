"""Every error the garden raises on purpose, as one tree.

GardenError
├── BadRequest (400)          the caller sent something we cannot take
│   ├── Unprocessable (422)
│   ├── Unauthorised (401)
│   ├── Forbidden (403)
│   ├── NotFound (404)
│   ├── Conflict (409)
│   ├── PreconditionFailed (412)
│   └── TooLarge (413)
├── ConfigError               a scenario, a setting or a key file is wrong
├── Unavailable (503)         we are fine, something we need is not
│   ├── LinkDown              a byte link closed or never opened
│   └── PeerDown (502)        another service did not answer
├── DriverError (502)         a device answered, but not as its protocol says
│   └── DriverTimeout (504)
├── Refused (409)             the safety gate or a market rule said no
│   └── Overtaken             a bid holds no more: other tasks were taken since
└── StorageError (507)        a document could not be made durable

Services turn them into RFC 9457 problem documents in one handler (`core.mesh.chassis`).
"""

from __future__ import annotations


class GardenError(Exception):
    """Base of all. `hint` says what would work; `status` is the HTTP status a service answers with."""

    status = 500
    title = "Internal error"

    def __init__(self, message: str, *, hint: str = "") -> None:
        super().__init__(message)
        self.hint = hint


class BadRequest(GardenError):
    status = 400
    title = "Bad request"


class Unprocessable(BadRequest):
    status = 422
    title = "Unprocessable content"


class Unauthorised(BadRequest):
    status = 401
    title = "Unauthorised"


class Forbidden(BadRequest):
    status = 403
    title = "Forbidden"


class NotFound(BadRequest):
    status = 404
    title = "Not found"


class Conflict(BadRequest):
    status = 409
    title = "Conflict"


class PreconditionFailed(BadRequest):
    status = 412
    title = "Precondition failed"


class TooLarge(BadRequest):
    status = 413
    title = "Content too large"


class ConfigError(GardenError):
    title = "Configuration error"


class Unavailable(GardenError):
    status = 503
    title = "Unavailable"


class LinkDown(Unavailable):
    """A byte link closed, or could not be opened."""


class PeerDown(Unavailable):
    """Another service refused the connection, timed out or answered nonsense."""

    status = 502


class DriverError(GardenError):
    status = 502
    title = "Device error"


class DriverTimeout(DriverError):
    status = 504

    def __init__(self, port: str, waited_s: float) -> None:
        super().__init__(f"no reply on {port} after {waited_s:.2f} s", hint="is the board powered and the cable in?")


class Refused(GardenError):
    """A rule of safety or of the market said no; the message is the reason shown to people."""

    status = 409
    title = "Refused"


class Overtaken(Refused):
    """An award came for a bid that other awards have made too cheap; the plant asks again."""

    title = "Overtaken"


class StorageError(GardenError):
    status = 507
    title = "Not durable"
