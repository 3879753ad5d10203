"""`python -m lab.bench.responder N`: N tiny robots on free ports that answer every request with the same bid."""

from __future__ import annotations

import asyncio
import json
import sys

from core.wire.market import Bid, Breakdown

_BODY = Bid(task_id="plant-1:1:1", robot_id="robot-1", cost_s=42.5, breakdown=Breakdown(travel_s=12.5, work_s=30.0))
BODY = _BODY.model_dump_json().encode()
ANSWER = b"HTTP/1.1 200 OK\r\ncontent-type: application/json\r\ncontent-length: %d\r\n\r\n" % len(BODY) + BODY


class Responder(asyncio.Protocol):
    """Counts bytes until head and body are in, then answers; as cheap as Python gets."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = transport
        self._pending = b""

    def data_received(self, data: bytes) -> None:
        self._pending += data
        while (head_end := self._pending.find(b"\r\n\r\n")) >= 0:
            head = self._pending[:head_end].lower()
            at = head.find(b"content-length:")
            length = int(head[at + 15 :].split(b"\r\n", 1)[0]) if at >= 0 else 0
            if len(self._pending) < head_end + 4 + length:
                return
            self._pending = self._pending[head_end + 4 + length :]
            assert isinstance(self._transport, asyncio.Transport)
            self._transport.write(ANSWER)


async def _serve(count: int) -> None:
    loop = asyncio.get_running_loop()
    servers = [await loop.create_server(Responder, "127.0.0.1", 0) for _ in range(count)]
    print(json.dumps([server.sockets[0].getsockname()[1] for server in servers]), flush=True)
    await loop.run_in_executor(None, sys.stdin.read)


if __name__ == "__main__":
    asyncio.run(_serve(int(sys.argv[1])))
