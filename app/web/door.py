"""The one port of the page: open as long as the process, while the application behind it changes.

That is a twin, another twin, or none. Clients of an application that is replaced are disconnected; they reconnect and
find the new one. Port, token and access rules stay.
"""

from __future__ import annotations

import asyncio
import json
import threading
import time
import uuid
from collections.abc import Sequence
from typing import Any

import h11
import uvicorn
from starlette.applications import Starlette
from starlette.responses import JSONResponse, PlainTextResponse
from starlette.routing import BaseRoute
from starlette.websockets import WebSocket
from uvicorn.protocols.http.h11_impl import H11Protocol

from .gate import App, Gate, Receive, Scope, Send, session_token
from .port import listen

GONE = 1012
"""WebSocket's code for a service that starts anew."""

NOTHING = "no twin runs; choose one in the gallery"

CONNECTIONS = 96
"""Open connections. A page holds up to eight; each of its Viser panes costs one more descriptor within the process, and
some systems allow 256 in all."""

BACKLOG = 64
"""Connections that may wait to be accepted."""

REQUEST_TIMEOUT_S = 10.0
"""From the first byte of a request, or the connection, to the last byte of its body."""


def _policy(port: int, scripts: str) -> str:
    """A content security policy under which no request leaves this server."""
    # Not every browser takes 'self' to include the WebSockets of the same address.
    names = (f"127.0.0.1:{port}", f"localhost:{port}")
    sockets, here = (" ".join(f"{scheme}://{name}" for name in names) for scheme in ("ws", "http"))
    return (
        f"default-src 'self'; script-src 'self' {scripts}; style-src 'self' 'unsafe-inline'; "
        f"img-src 'self' data: blob:; font-src 'self' data:; connect-src 'self' data: blob: {sockets}; "
        f"worker-src 'self' blob: data:; frame-src 'self' {here}; frame-ancestors 'self' {here}; object-src 'none'; "
        "base-uri 'none'; form-action 'self'"
    )


class Shown:
    """An application behind the door; `boot` distinguishes it from those before."""

    def __init__(self, application: App, boot: str) -> None:
        self.application, self.boot = application, boot
        self.left = asyncio.Event()
        """Set by the server's thread when another application has taken its place."""
        self.over = threading.Event()
        """Set once it has no connection left either."""
        self._open = 0

    async def stream(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve a WebSocket while this application is shown."""
        self._open += 1
        try:
            await self.application(scope, _until(receive, self.left), send)
        finally:
            self._open -= 1
            self._look()

    def leave(self) -> None:
        """Give way to another application; in the server's thread."""
        self.left.set()
        self._look()

    def _look(self) -> None:
        if self.left.is_set() and not self._open:
            self.over.set()


class Door:
    """Serves its own routes, then the application that is shown, from a thread of its own."""

    def __init__(self, port: int) -> None:
        """Take the port; 0 takes a free one.

        Raises:
            ConfigError: If the port cannot be had.
        """
        self._listening = listen(port)
        self.port = self._listening.port
        self._token = session_token()
        self._shown = Shown(self._nothing, uuid.uuid4().hex)
        self._page: App | None = None
        self._own = Starlette()
        self._own.router.default = self._behind
        self._own.router.redirect_slashes = False
        self._loop: asyncio.AbstractEventLoop | None = None
        gate = Gate(_WithHeaders(self._enter, self.port), self._token, self.port)
        self.entered = gate.entered
        self.stage_pass = gate.stage_pass if self._listening.localhost else None
        """Pass for a frame under the other loopback name to see the stage; None where that name may not be ours."""
        config = uvicorn.Config(
            gate, log_config=None, log_level="critical", access_log=False,
            server_header=False, lifespan="off", ws_per_message_deflate=False, timeout_graceful_shutdown=1, 
            http=BoundedProtocol, backlog=BACKLOG,
        )  # fmt: skip
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(
            target=self._server.run, kwargs={"sockets": self._listening.sockets}, name="page server", daemon=True
        )

    @property
    def url(self) -> str:
        """Address of the page, with its token."""
        return f"http://127.0.0.1:{self.port}/?token={self._token}"

    @property
    def boot(self) -> str:
        """Identity of the application that is shown: a page of another one reloads."""
        return self._shown.boot

    @property
    def furnished(self) -> bool:
        """Whether it has routes of its own: a gallery."""
        return bool(self._own.routes)

    def furnish(self, routes: Sequence[BaseRoute], page: App) -> None:
        """Add routes that are always served, and the page for when nothing is shown; before the start."""
        self._own.router.routes.extend(routes)
        self._page = page

    def show(self, application: App | None, boot: str | None = None) -> threading.Event:
        """Put another application behind the door, or none; from any thread.

        Returns:
            An event that is set once the previous application has no connection left.
        """
        before = self._shown
        boot = uuid.uuid4().hex if boot is None else boot
        self._shown = Shown(self._nothing if application is None else application, boot)
        if self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(before.leave)
        else:
            before.over.set()
        return before.over

    def start(self) -> None:
        """Serve."""
        self._thread.start()
        while not self._server.started and self._thread.is_alive():
            time.sleep(0.005)

    def stop(self) -> None:
        """Close all connections, and the port."""
        self._server.should_exit = True
        if self._thread.is_alive():
            self._thread.join(timeout=5.0)
        self._listening.close()

    async def _enter(self, scope: Scope, receive: Receive, send: Send) -> None:
        self._loop = asyncio.get_running_loop()
        await self._own(scope, receive, send)

    async def _behind(self, scope: Scope, receive: Receive, send: Send) -> None:
        shown = self._shown
        scope.pop("router", None)
        serve = shown.stream if scope["type"] == "websocket" else shown.application
        await serve(scope, receive, send)

    async def _nothing(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer while no twin runs: a page that still shows one reloads, others get the reason."""
        if scope["type"] == "websocket":
            browser = WebSocket(scope, receive, send)
            await browser.accept()
            await browser.send_text(json.dumps({"boot": self.boot}))
            await browser.close(GONE)
        elif scope["path"] == "/" and self._page is not None:
            await self._page(scope, receive, send)
        elif scope["path"].startswith("/api/"):
            await JSONResponse({"error": NOTHING}, 409)(scope, receive, send)
        else:
            await PlainTextResponse(f"Nisus: {NOTHING}.\n", 404)(scope, receive, send)


def _until(receive: Receive, left: asyncio.Event) -> Receive:
    """Return a `receive` that disconnects once the application has gone."""

    async def take() -> Any:
        said, gone = asyncio.ensure_future(receive()), asyncio.ensure_future(left.wait())
        try:
            await asyncio.wait({said, gone}, return_when=asyncio.FIRST_COMPLETED)
            return said.result() if said.done() else {"type": "websocket.disconnect", "code": GONE}
        finally:
            said.cancel()
            gone.cancel()

    return take


class _WithHeaders:
    """Adds the security headers to every answer."""

    def __init__(self, application: App, port: int) -> None:
        self._application = application
        common = [
            (b"x-content-type-options", b"nosniff"),
            (b"referrer-policy", b"no-referrer"),
            (b"cross-origin-resource-policy", b"same-origin"),
            (b"cross-origin-opener-policy", b"same-origin"),
        ]
        own = _policy(port, "'wasm-unsafe-eval'")
        # Viser's client is one file of inline scripts that unpack themselves.
        viser = _policy(port, "'unsafe-inline' 'unsafe-eval' 'wasm-unsafe-eval' blob: data:")
        self._own = [*common, (b"content-security-policy", own.encode())]
        self._viser = [*common, (b"content-security-policy", viser.encode())]

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        extra = self._viser if scope.get("path", "").startswith("/viser") else self._own

        async def send_more(message: Any) -> None:
            if message["type"] == "http.response.start":
                headers = [*message.get("headers", []), *extra]
                if not any(name == b"cache-control" for name, _ in headers):
                    headers.append((b"cache-control", b"no-cache"))
                message = {**message, "headers": headers}
            await send(message)

        await self._application(scope, receive, send_more)


class BoundedProtocol(H11Protocol):
    """uvicorn's HTTP, with a time for each request and a number of connections, neither of which uvicorn bounds."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Take the connection; if there are too many, the one idle for longest is closed."""
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
        """Forget the connection's deadline."""
        self._done()
        super().connection_lost(exc)

    def on_response_complete(self) -> None:
        """Expect the next request, the start of which may have arrived already."""
        self._since = self.loop.time()
        super().on_response_complete()

    def _idle(self, newcomer: BoundedProtocol) -> bool:
        """Return whether no request of this connection is being answered, so that it may be closed."""
        return self is not newcomer and (self.cycle is None or self.cycle.response_complete)

    def _watch(self) -> None:
        """Set a deadline while a request is expected or incomplete; between two, uvicorn closes by itself."""
        upgraded = self.transport.get_protocol() is not self
        if upgraded or self.conn.their_state not in (h11.IDLE, h11.SEND_BODY):
            self._done()
        elif self._deadline is None:
            self._deadline = self.loop.call_later(REQUEST_TIMEOUT_S, self.transport.close)

    def _done(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None
