"""How much the page server takes from whoever connects: so many connections, so long for a request, so many bytes.

Any program of this machine can connect, before it has shown a token. Connections that say nothing must not use up the
descriptors of the process, which the recorder and the sources need too.
"""

from __future__ import annotations

import asyncio
from typing import Any

import h11
from starlette.requests import ClientDisconnect, Request
from uvicorn.protocols.http.h11_impl import H11Protocol

from estimators.errors import ConfigError

CONNECTIONS = 96
"""Open at a time. A page holds up to eight; each of its Viser panes costs one more descriptor within the process, and
some systems allow 256 in all."""

BACKLOG = 64
"""Connections that are accepted at once, before the first of them can be refused."""

SECONDS = 10.0
"""From the first byte of a request, or the connection, to the last byte of its body."""

BODY = 64 * 1024
"""Bytes of a request's body, or of a browser's message on a stream; commands take a hundred."""


class BoundedProtocol(H11Protocol):
    """uvicorn's HTTP, with a time for each request and a number of connections, neither of which uvicorn bounds."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Take the connection; if there are too many, the one that has been silent longest makes room."""
        super().connection_made(transport)
        self._since = self.loop.time()
        self._deadline: asyncio.TimerHandle | None = None
        self._watch()
        there = [other for other in self.connections if not other.transport.is_closing()]  # type: ignore[union-attr]
        if len(there) > CONNECTIONS:
            idle = [other for other in there if isinstance(other, BoundedProtocol) and other._idle(self)]
            min(idle, key=lambda other: other._since, default=self).transport.abort()

    def data_received(self, data: bytes) -> None:
        """Take bytes of a request."""
        super().data_received(data)
        self._watch()

    def connection_lost(self, exc: Exception | None) -> None:
        """The connection is gone."""
        self._done()
        super().connection_lost(exc)

    def on_response_complete(self) -> None:
        """The next request may begin; what it began with may be here already."""
        self._since = self.loop.time()
        super().on_response_complete()

    def _idle(self, newcomer: BoundedProtocol) -> bool:
        """Whether no request of this connection is being answered; it may be closed then."""
        return self is not newcomer and (self.cycle is None or self.cycle.response_complete)

    def _watch(self) -> None:
        """Set a deadline while a request is expected or incomplete; between two, uvicorn closes by itself."""
        upgraded = self.transport.get_protocol() is not self
        if upgraded or self.conn.their_state not in (h11.IDLE, h11.SEND_BODY):
            self._done()
        elif self._deadline is None:
            self._deadline = self.loop.call_later(SECONDS, self.transport.close)

    def _done(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None


class TooLarge(ConfigError):
    """A request's body has more bytes than any command needs."""


async def bounded_body(request: Request, most: int = BODY) -> bytes:
    """The body of a request.

    Raises:
        TooLarge: If it has more than `most` bytes; the rest is not read.
        ConfigError: If it never came to its end.
    """
    body = bytearray()
    try:
        async for piece in request.stream():
            body += piece
            if len(body) > most:
                raise TooLarge(f"a request's body may have {most // 1024} kB; send one command at a time")
    except ClientDisconnect:
        raise ConfigError("the request ended before its body did; send it again") from None
    return bytes(body)


def bounds() -> dict[str, Any]:
    """The settings of uvicorn that belong to these bounds."""
    return {"http": BoundedProtocol, "backlog": BACKLOG}
