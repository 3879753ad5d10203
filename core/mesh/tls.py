"""TLS between nodes: certificates of the garden's own authority say who is at either end of a link.

A certificate names its node by one URI, as SPIFFE does: `spiffe://GARDEN/ROLE/NODE`. Nodes know each other by that name and
not by where they answer, so that addresses may change and no node can stand in for another. People's programs (curl,
browsers) look at addresses: every certificate also names its node as a host, `localhost` and the loopback addresses.
`core.mesh.authority` makes the files.
"""

from __future__ import annotations

import ssl
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from core.errors import ConfigError

AUTHORITY, CERTIFICATE, KEY = "ca.crt", "tls.crt", "tls.key"
"""The files of a node's key folder."""


def serving(keys: Path) -> ssl.SSLContext:
    """To answer with this node's certificate; whoever shows one must be of the garden. Raises ConfigError."""
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    _trust(context, keys)
    _show(context, keys)
    context.verify_mode = ssl.CERT_OPTIONAL
    return context


def asking(keys: Path) -> ssl.SSLContext:
    """To ask nodes of the garden, whatever their address; shows this node's certificate. Raises ConfigError.

    Who has answered is for the caller to look at: `name_in` tells.
    """
    context = ssl.create_default_context(cafile=_authority(keys))
    context.check_hostname = False
    if (keys / CERTIFICATE).exists():
        _show(context, keys)
    return context


def by_address(keys: Path, *, show: bool = False) -> ssl.SSLContext:
    """To ask a host by its address: one of the garden, or one that the machine's own authorities vouch for. ConfigError.

    With `show` it shows this node's certificate to those who ask for one.
    """
    context = ssl.create_default_context()
    _trust(context, keys)
    if show:
        _show(context, keys)
    return context


def name_in(certificate: Mapping[str, Any] | None) -> str:
    """The node that a verified certificate (`ssl.SSLSocket.getpeercert`) names; nothing where there is none."""
    told = (value for kind, value in (certificate or {}).get("subjectAltName", ()) if kind == "URI")
    for uri in told:
        parts = urlsplit(uri)
        _, _, name = parts.path.removeprefix("/").partition("/")
        if parts.scheme == "spiffe" and name:
            return unquote(name)
    return ""


def _trust(context: ssl.SSLContext, keys: Path) -> None:
    context.load_verify_locations(cafile=_authority(keys))


def _show(context: ssl.SSLContext, keys: Path) -> None:
    try:
        context.load_cert_chain(keys / CERTIFICATE, keys / KEY)
    except OSError as error:
        raise ConfigError(
            f"no certificate to show in {keys}: {error.strerror or error}", hint="run `garden init`"
        ) from error


def _authority(keys: Path) -> Path:
    if not (keys / AUTHORITY).is_file():
        raise ConfigError(f"there is no {AUTHORITY} in {keys}", hint="run `garden init`")
    return keys / AUTHORITY
