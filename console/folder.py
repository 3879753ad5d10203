"""The data folder of a garden on this machine: keys, logs, documents, and who answers where."""

from __future__ import annotations

import hashlib
import json
import os
import ssl
import tempfile
import time
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath

from pydantic import TypeAdapter, ValidationError

from console.processes import SOCKET_PATH_MAX, Place, enrolled, peers_of
from core import scenario as scenarios
from core.errors import ConfigError
from core.mesh import tls
from core.mesh.auth import Enrolled, Identity, make_garden
from core.mesh.authority import certify
from core.mesh.http import HttpTransport
from core.mesh.peers import Peer, Peers
from core.scenario import Scenario

LOCALHOST = "127.0.0.1"
_PEERS: TypeAdapter[list[Peer]] = TypeAdapter(list[Peer])


@dataclass(frozen=True, slots=True)
class Folder:
    """`--data DIR`; its files are made by `garden init` and `garden up`."""

    root: Path

    @property
    def keys(self) -> Path:
        return self.root / "keys"

    @property
    def logs(self) -> Path:
        return self.root / "logs"

    @property
    def scenario_file(self) -> Path:
        """The scenario as it runs, ports shifted."""
        return self.root / "scenario.toml"

    def place(self) -> Place:
        """The local processes' view of this folder."""
        root = PurePosixPath(self.root.resolve())
        return Place(
            data=lambda name: root / name,
            keys=lambda name: root / "keys" / name,
            socket=lambda robot: f"unix://{self.socket_path(robot)}",
            scenario=str(self.scenario_file.resolve()),
        )

    def socket_path(self, robot: str) -> Path:
        """Below the folder, or, where that path would be too long for a socket, below the temporary folder."""
        path = self.root.resolve() / f"{robot}-body" / "body.sock"
        if len(str(path)) <= SOCKET_PATH_MAX:
            return path
        name = hashlib.sha256(str(path).encode()).hexdigest()[:16]
        return Path(tempfile.gettempdir()) / f"garden-{os.getuid()}-{name}.sock"

    def enrol(self, scenario: Scenario, more: tuple[Enrolled, ...] = ()) -> list[str]:
        """Make the keys, tokens and certificates that are missing; tells which."""
        nodes = [*enrolled(scenario), *more]
        # Tokens live in Unix time: the clock of a real garden, and never reached by a simulated one.
        made = make_garden(self.keys, nodes, time.time())
        return list(dict.fromkeys([*made, *certify(self.keys, nodes, datetime.now(UTC))]))

    def remember(self, scenario: Scenario) -> None:
        """Write down who answers where, for the other commands."""
        self.root.mkdir(parents=True, exist_ok=True)
        peers = [peer.model_dump() for peer in peers_of(scenario, lambda name: LOCALHOST)]
        (self.root / "peers.json").write_text(json.dumps(peers, indent=1))

    def identity(self, role: str = "operator") -> Identity:
        """`GARDEN_TOKEN`, or the role's token from this folder; raises ConfigError when there is none."""
        if token := os.environ.get("GARDEN_TOKEN"):
            return Identity("operator", role, token)
        return Identity.load(self.keys / role)

    def transport(self, peers: Peers) -> HttpTransport:
        """The way to `peers`: by the garden's certificates where they speak TLS and this folder has them."""
        holder = self.keys / "operator"
        if (holder / tls.AUTHORITY).exists() and any(peer.url.startswith("https:") for peer in peers.all()):
            return HttpTransport(tls.asking(holder), peers.at)
        return HttpTransport()

    def trusted(self) -> ssl.SSLContext | None:
        """For programs that look at addresses; None where this folder has no certificates."""
        holder = self.keys / "operator"
        return tls.by_address(holder) if (holder / tls.AUTHORITY).exists() else None

    def peers_written(self) -> list[Peer]:
        """What `remember` wrote."""
        return _PEERS.validate_json((self.root / "peers.json").read_bytes())

    def peers(self) -> list[Peer]:
        """`GARDEN_PEERS`, what `garden up` wrote down, or the default garden's addresses."""
        try:
            if listed := os.environ.get("GARDEN_PEERS"):
                return _PEERS.validate_json(listed)
            if (self.root / "peers.json").exists():
                return self.peers_written()
        except ValidationError as error:
            raise ConfigError("the list of peers is broken", hint=f"see GARDEN_PEERS and {self.root}/peers.json") from error
        return peers_of(scenarios.find("garden"), lambda name: LOCALHOST)
