"""A Viser server that only our own page server can reach.

Viser serves every connection, checks no Origin, and lets any client request a public tunnel. Here each HTTP request
and each WebSocket upgrade must carry a secret that only the page's proxy has, and the tunnel is removed.
"""

from __future__ import annotations

import asyncio
import hmac
import http
import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

import rich
import viser
import websockets.asyncio.server
from viser import _messages
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response
from websockets.protocol import State

BACKLOG = 64  # Connections waiting for acceptance


HEADER = "X-Nisus-Secret"

MAX_CONNECTIONS = 96
"""Open connections, as many as the page has: only its server should connect, but any process can."""

_patching = threading.Lock()


def guarded_server(secret: str, label: str) -> viser.ViserServer:
    """Return a Viser server on a free loopback port that answers 403 to requests without the secret."""
    logging.getLogger("websockets.server").addFilter(_is_failure)
    with _patching, unprinted():
        serve = websockets.asyncio.server.serve

        def guarded_serve(*args: Any, process_request: Callable, **options: Any) -> Any:
            guard = _guard(process_request, secret)
            return serve(*args, process_request=guard, create_connection=_Bounded, backlog=BACKLOG, **options)

        # Viser has no option for this, and its constructor returns once the port is bound: patch just that long.
        websockets.asyncio.server.serve = guarded_serve  # type: ignore[misc,assignment]
        try:
            server = viser.ViserServer(host="127.0.0.1", port=0, label=label, verbose=False)
        finally:
            websockets.asyncio.server.serve = serve  # type: ignore[misc]
    # The theme only hides the button; a client could still ask for the tunnel.
    server._websock_server.unregister_handler(_messages.ShareUrlRequest)
    return server


def addresses(server: viser.ViserServer) -> list[str]:
    """Return the query of each connected browser's WebSocket address."""
    # Viser lists its clients, but not their addresses.
    connections = list(server._websock_server._live_connections.values())
    return [urlsplit(there.request.path).query for there in connections if there.request is not None]


def when_connected(server: viser.ViserServer, call: Callable[[], object]) -> None:
    """Call when a browser has connected; `addresses` has it then."""
    server._websock_server.on_client_connect(lambda _: call())  # Viser's own comes only with the first camera


@contextmanager
def unprinted() -> Iterator[None]:
    """Suppress Viser's output: an address that answers 403, and that it stopped."""
    console = rich.get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before


def _is_failure(record: logging.LogRecord) -> bool:
    """Return whether to log a record; a connection without a request is no failure."""
    return record.getMessage() != "opening handshake failed"


class _Bounded(ServerConnection):
    """Connection that, if there are too many, closes the oldest one without a request."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        there = [other for other in self.server.handlers if not other.transport.is_closing()]
        if len(there) > MAX_CONNECTIONS:
            next(
                other for other in there if other is self or other.protocol.state is State.CONNECTING
            ).transport.abort()


def _guard(inner: Callable, secret: str) -> Callable:
    wanted = secret.encode()

    def process_request(connection: ServerConnection, request: Request) -> Response | None:
        given = request.headers.get_all(HEADER)
        if len(given) == 1 and hmac.compare_digest(given[0].encode("utf-8", "surrogateescape"), wanted):
            return inner(connection, request)
        body = b"Nisus: open the page at the address that `nisus run` printed.\n"
        headers = Headers({"Content-Type": "text/plain", "Content-Length": str(len(body)), "Connection": "close"})
        return Response(http.HTTPStatus.FORBIDDEN.value, "Forbidden", headers, body)

    return process_request
