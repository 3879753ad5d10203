"""Soil probes and taps by URL: a byte link with Firmata behind it, or a Linux IIO device.

- `socket://HOST:PORT?pin=0`, `/dev/ttyACM0?baud=57600&pin=1`, `memory://NAME?pin=0&vref=3.3`: an Arduino's analog input
- `iio:///sys/bus/iio/devices?name=mcp3008&channel=0`, or `?index=0&channel=0`: Linux sysfs

`pin`, `vref`, `bits` and `valve` are taken out of the URL before the link is opened; what is left is the link's own.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, urlencode, urlsplit

from core.clock import Clock
from core.errors import ConfigError
from hw.drivers.firmata import FirmataBoard, FirmataValve
from hw.drivers.iio import ROOT, IioProbe
from hw.links import Opener
from hw.ports import SoilProbe

FIRMATA_BAUD = "57600"
OURS = ("pin", "vref", "bits", "valve")


def open_probe(url: str, opener: Opener, clock: Clock) -> SoilProbe:
    """The probe a URL means; nothing is opened before its `run`. Raises ConfigError for a URL that makes no sense."""
    if urlsplit(url).scheme == "iio":
        return _open_iio(url, clock)
    link_url, query = _split(url)
    return _board(url, link_url, query, opener, clock).probe(_number(url, query, "pin", 0, int))


def open_valve(url: str, opener: Opener, clock: Clock) -> FirmataValve:
    """The tap a URL means: `?valve=8` names the digital pin (default 8)."""
    link_url, query = _split(url)
    return _board(url, link_url, query, opener, clock).valve(_number(url, query, "valve", 8, int))


def _board(url: str, link_url: str, query: dict[str, str], opener: Opener, clock: Clock) -> FirmataBoard:
    vref_v = _number(url, query, "vref", 5.0, float)
    bits = _number(url, query, "bits", 10, int)
    if not (vref_v > 0 and 1 <= bits <= 14):
        raise ConfigError(f"{url!r} has a converter of {bits} bits at {vref_v} V", hint="for an Uno: vref=5, bits=10")
    return FirmataBoard(link_url, opener, clock, vref_v=vref_v, bits=bits)


def _open_iio(url: str, clock: Clock) -> IioProbe:
    parts = urlsplit(url)
    query = dict(parse_qsl(parts.query))
    if ("name" in query) == ("index" in query):
        raise ConfigError(f"{url!r} must give a name or an index", hint="iio:///sys/bus/iio/devices?name=mcp3008")
    device = query["name"] if "name" in query else _number(url, query, "index", 0, int)
    root = Path(parts.path) if parts.path.strip("/") else ROOT
    return IioProbe(root, device, _number(url, query, "channel", 0, int), clock)


def _split(url: str) -> tuple[str, dict[str, str]]:
    """The link's URL and our own part of the query. A serial port is opened at Firmata's 57600 unless it says `baud`."""
    parts = urlsplit(url)
    pairs = parse_qsl(parts.query)
    theirs = [(key, value) for key, value in pairs if key not in OURS]
    if parts.scheme in ("", "serial") and "baud" not in dict(theirs):
        theirs.append(("baud", FIRMATA_BAUD))
    link_url = url.partition("?")[0] + ("?" + urlencode(theirs) if theirs else "")
    return link_url, {key: value for key, value in pairs if key in OURS}


def _number(url: str, query: dict[str, str], key: str, default: Any, kind: type[Any]) -> Any:
    try:
        return kind(query[key]) if key in query else default
    except ValueError:
        raise ConfigError(f"{key}={query[key]!r} in {url!r} is not a number") from None
