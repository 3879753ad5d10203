"""What every service process does before it is itself: settings, logs, clock, keys, peers."""

from __future__ import annotations

import asyncio
import logging
import ssl
import sys
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import TYPE_CHECKING, Annotated, Literal
from urllib.parse import urlsplit

import structlog
from pydantic import Field, field_validator
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict

from core.clock import Clock, WallClock, WorldClock
from core.errors import ConfigError, GardenError
from core.mesh import tls
from core.mesh.auth import Identity, Verifier
from core.mesh.client import Mesh, PeerTransport
from core.mesh.introduction import ROLE_OF
from core.mesh.node import Loop, Node, serve
from core.mesh.peers import Peer, Peers
from core.mesh.presence import introducer

if TYPE_CHECKING:
    from core.mesh.courier import Courier

FIRST_TIME_WITHIN_S = 90.0
"""The world may still be compiling itself."""


class GardenSettings(BaseSettings):
    """What all services share; read from `GARDEN_...` variables."""

    model_config = SettingsConfigDict(env_prefix="GARDEN_", frozen=True)

    clock: Annotated[str, Field(pattern=r"^(wall|https?://\S+)$")] = "wall"
    """`wall`, or the URL of the world whose time is followed."""
    keys: Path | None = None
    """This node's own key folder; without one the node has no identity and accepts no change."""
    peers: list[Peer] = []
    discovery: Annotated[tuple[Literal["mdns", "routes"], ...], NoDecode] = ()
    """How peers are found beside that list, separated by commas."""
    discovery_port: Annotated[int, Field(ge=1, le=65535)] = 8100
    """Where the service of every host listens that a routing table names."""
    hop_protocols: Annotated[tuple[Annotated[int, Field(ge=1, le=255)], ...], NoDecode] = (42,)
    """Kernel route protocols, separated by commas, whose metric counts hops: babeld's; olsrd's is the one it is given."""
    hops_max: Annotated[int, Field(ge=1, le=255)] = 255
    """Robots and plants farther away are not asked."""
    flood_hops: Annotated[int, Field(ge=0, le=16)] = 0
    """Neighbours pass requests on, this far: for a radio without routing. 0: nobody does."""
    host: str = "127.0.0.1"
    port: Annotated[int, Field(ge=0, le=65535)] = 0
    log: Literal["auto", "json", "text"] = "auto"
    tls: bool = False
    """Answer and ask over TLS alone, with the garden's certificates."""
    open_reads: bool = True
    """Reading needs no token. Right only while the port is published on loopback."""
    seed: int = 0

    @field_validator("discovery", "hop_protocols", mode="before")
    @classmethod
    def _split(cls, value: object) -> object:
        return tuple(part.strip() for part in value.split(",") if part.strip()) if isinstance(value, str) else value


@dataclass(frozen=True, slots=True)
class Runtime:
    """The common parts, made for one process."""

    settings: GardenSettings
    clock: Clock
    clock_loops: Sequence[Loop]
    identity: Identity | None
    verifier: Verifier
    peers: Peers
    transport: PeerTransport
    courier: Courier | None = None
    """The transport, where requests are flooded."""

    def mesh(self, timeout_s: float = 2.0) -> Mesh:
        return Mesh(self.transport, self.identity, self.clock, timeout_s)


def make_clock(settings: GardenSettings) -> tuple[Clock, Sequence[Loop]]:
    """The clock `GARDEN_CLOCK` names, and the loops that keep it right."""
    if settings.clock == "wall":
        return WallClock(), ()
    from core.mesh import worldclock

    clock = WorldClock()
    trusted = tls.by_address(key_folder(settings), show=not settings.open_reads) if settings.tls else None
    shown = reading(settings)
    return clock, (lambda: worldclock.follow(clock, settings.clock, tls=trusted, headers=shown),)


def reading(settings: GardenSettings) -> dict[str, str]:
    """The headers of what this node reads past the mesh: its token where reads are closed. Raises ConfigError."""
    return {} if settings.open_reads else {"authorization": f"Bearer {Identity.load(key_folder(settings)).token}"}


def key_folder(settings: GardenSettings) -> Path:
    """Raises ConfigError when the settings name none."""
    if settings.keys is None:
        raise ConfigError("GARDEN_KEYS names no key folder", hint="run `garden init`, then set GARDEN_KEYS=DATA/keys/NODE")
    return settings.keys


def make_runtime(settings: GardenSettings | None = None) -> Runtime:
    """Call inside the running loop; raises ConfigError for missing or broken key files."""
    from core.mesh.http import HttpTransport

    settings = settings or GardenSettings()
    keys = key_folder(settings)
    clock, clock_loops = make_clock(settings)
    identity, verifier = Identity.load(keys), Verifier.load(keys)
    peers = Peers(settings.peers, settings.hops_max)
    transport = HttpTransport(tls.asking(keys), peers.at) if settings.tls else HttpTransport()
    courier = make_courier(settings, clock, identity, verifier, peers, transport)
    return Runtime(settings, clock, clock_loops, identity, verifier, peers, courier or transport, courier)


def make_courier(
    settings: GardenSettings, clock: Clock, identity: Identity, verifier: Verifier, peers: Peers, transport: PeerTransport
) -> Courier | None:
    """None where requests are not flooded: such a process does not even load what that takes."""
    if not settings.flood_hops:
        return None
    from core.mesh.courier import Courier
    from core.mesh.relay import Relay

    relay = Relay(settings.flood_hops, peers, verifier, identity, transport, clock)
    return Courier(relay, Random(f"{settings.seed}:{identity.subject}:courier"))


def joining(courier: Courier | None, identity: Identity | None, node: Node) -> Sequence[Loop]:
    """Make the node one that passes parcels on, and the loops for it; raises ConfigError."""
    if courier is None:
        return ()
    me = introducer(identity, node.kind, node.url)
    if me is None or node.kind not in ROLE_OF:
        hint = "GARDEN_FLOOD_HOPS is for pots, stations and robots with keys and a URL of their own (PLANT_URL, ROBOT_URL)"
        raise ConfigError(f"{node.id} cannot pass requests on", hint=hint)
    return courier.join(me, node.app)


def setup_logging(how: str = "auto") -> None:
    """structlog to stderr: JSON lines, or text on a terminal. The standard library's warnings go the same way."""
    text = how == "text" or (how == "auto" and sys.stderr.isatty())
    # Without what variables held: tokens and keys are among them, and rich pictures of them take a second of the loop.
    plain = structlog.dev.ConsoleRenderer(exception_formatter=structlog.dev.plain_traceback)
    stack = structlog.processors.ExceptionRenderer(structlog.tracebacks.ExceptionDictTransformer(show_locals=False))
    final = plain if text else structlog.processors.JSONRenderer()
    structlog.configure(
        processors=[
            structlog.contextvars.merge_contextvars,
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso"),
            structlog.processors.StackInfoRenderer() if text else stack,
            final,
        ],
        wrapper_class=structlog.make_filtering_bound_logger(logging.INFO),
        logger_factory=structlog.PrintLoggerFactory(sys.stderr),
        cache_logger_on_first_use=True,
    )
    logging.basicConfig(level=logging.WARNING, stream=sys.stderr, format="%(name)s: %(message)s")


Builder = Callable[[Runtime], Awaitable[Node]]


def run(build: Builder) -> None:
    """A service's whole `main`: build the node, serve it, end with 0 on SIGTERM and 1 on any failure."""
    try:
        settings = GardenSettings()
    except ValueError as error:
        sys.exit(f"a GARDEN_ setting is wrong: {error}")
    setup_logging(settings.log)
    log = structlog.get_logger("garden.run")
    try:
        asyncio.run(_run(build, settings))
    except GardenError as error:
        log.error("cannot start", why=str(error), hint=error.hint)
        sys.exit(1)
    except Exception as error:
        for cause in _causes(error):
            log.error("ended by an error", why=f"{type(cause).__name__}: {cause}", exc_info=cause)
        sys.exit(1)


def _causes(error: BaseException) -> list[BaseException]:
    if isinstance(error, BaseExceptionGroup):
        return [cause for inner in error.exceptions for cause in _causes(inner)]
    return [error]


async def _run(build: Builder, settings: GardenSettings) -> None:
    runtime = make_runtime(settings)
    try:
        async with asyncio.TaskGroup() as group:
            clocks = [group.create_task(_endless(loop)) for loop in runtime.clock_loops]
            await _first_time(runtime.clock)
            node = await build(runtime)
            structlog.contextvars.bind_contextvars(node=node.id)
            loops = (*finding(runtime, node), *joining(runtime.courier, runtime.identity, node))
            await serve(node, settings.host, settings.port, loops, tls=links(settings, node))
            for task in clocks:
                task.cancel()
    finally:
        await runtime.transport.aclose()


def links(settings: GardenSettings, node: Node) -> ssl.SSLContext | None:
    """What this node answers with where the garden speaks TLS; raises ConfigError."""
    if not settings.tls:
        return None
    if node.url.startswith("http:"):
        raise ConfigError(
            f"{node.id} says that it answers at {node.url}", hint="under GARDEN_TLS its URL begins with https://"
        )
    return tls.serving(key_folder(settings))


def finding(runtime: Runtime, node: Node) -> Sequence[Loop]:
    """The loops that find this node's peers, besides the static list; raises ConfigError."""
    from core.mesh.discovery import Discovery, Source
    from core.mesh.mdns import MulticastDns
    from core.mesh.routes import KernelRoutes

    settings = runtime.settings
    if not settings.discovery:
        return ()
    if not node.url:
        raise ConfigError(f"{node.id} does not know its own URL, so nobody can find it", hint="set PLANT_URL or ROBOT_URL")
    made: dict[str, Source] = {
        "mdns": MulticastDns(node.id, node.kind, node.url),
        "routes": KernelRoutes(runtime.clock, settings.discovery_port, urlsplit(node.url).scheme, settings.hop_protocols),
    }
    # With the time, so that no number drawn in a former life is drawn again: answers to it may have been kept.
    rng = Random(f"{settings.seed}:{node.id}:{runtime.clock.now()}")
    discovery = Discovery(
        node.id, runtime.peers, runtime.transport, runtime.verifier, runtime.clock, rng,
        [made[name] for name in settings.discovery], loopback=urlsplit(node.url).hostname in ("127.0.0.1", "::1"),
    )  # fmt: skip
    return discovery.loops()


async def _endless(loop: Loop) -> None:
    await loop()


async def _first_time(clock: Clock) -> None:
    """Wait for the world's first word, so that no loop sees garden time jump from zero."""
    if not isinstance(clock, WorldClock):
        return
    try:
        async with asyncio.timeout(FIRST_TIME_WITHIN_S):
            while clock.rate == 0 and clock.now() == 0:  # noqa: ASYNC110 (the clock has no event for its first word)
                await asyncio.sleep(0.02)
    except TimeoutError:
        raise ConfigError("the world tells no time", hint="is GARDEN_CLOCK the URL of a running sim?") from None
