"""Keys and tokens: the small commands that ask nobody else."""

from __future__ import annotations

import json
import os
from pathlib import Path

from console.folder import Folder
from core import scenario as scenarios
from core.errors import ConfigError


def init(scenario: str, data: Path, owner: int, as_json: bool) -> None:
    found = scenarios.find(scenario)
    folder = Folder(data)
    made = folder.enrol(found)
    if owner >= 0:
        for path in (folder.keys, *folder.keys.rglob("*")):
            os.chown(path, owner, owner)
    else:
        folder.remember(found)
    if as_json:
        print(json.dumps({"made": made, "keys": str(folder.keys)}))
    else:
        print(f"made in {folder.keys}: {', '.join(made)}" if made else f"nothing to make: {folder.keys} is complete")


def token(role: str, data: Path, as_json: bool) -> None:
    if role not in ("operator", "viewer"):
        raise ConfigError(f"no token for {role!r} is kept here", hint="operator or viewer")
    identity = Folder(data).identity(role)
    print(json.dumps({"token": identity.token, "role": identity.role}) if as_json else identity.token)
