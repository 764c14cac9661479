"""The one port of the page: open as long as the process, while the application behind it changes.

The application is that of a twin, of another twin, or none. Clients of a replaced application are disconnected;
they reconnect and find the new one. Port, token and access rules stay.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import functools
import os
import secrets
import socket
import threading
import time
import uuid
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Protocol

import h11
import uvicorn
from anyio import to_thread
from starlette.applications import Starlette
from starlette.datastructures import QueryParams
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse
from starlette.routing import BaseRoute, Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket
from uvicorn.protocols.http.h11_impl import H11Protocol

from estimators.errors import ConfigError

from ..engine.jobs import LoopThread
from .access import SESSION, USER, AccessControl, Grant, User, changes, with_security_headers
from .http import PARSED_BODY
from .request_threads import REQUEST_THREADS

SERVICE_RESTART = 1012
"""Close code of a WebSocket whose application is replaced."""

NO_TWIN = "no twin runs; choose one in the gallery"

MAX_CONNECTIONS = 96
"""Open connections. A page holds up to eight; each of its Viser panes costs one more descriptor within the process, and
some systems allow 256 in all."""

BACKLOG = 64
"""Connections that may wait to be accepted."""

MAX_NOTED_BYTES = 4096
"""Longest body that an audit log keeps."""

REQUEST_TIMEOUT_S = 10.0
"""From the first byte of a request, or the connection, to the last byte of its body."""


LOOPBACK = "127.0.0.1"


def listen(port: int, host: str = LOOPBACK) -> tuple[list[socket.socket], bool]:
    """Listen on 127.0.0.1, and on ::1 where it exists, as `localhost` may mean either; port 0 takes a free one.

    Or on another address alone.

    Returns:
        The sockets, and whether `localhost` leads to them and to no other program.

    Raises:
        ConfigError: If the port is not free on 127.0.0.1.
    """
    try:
        first = _listener(socket.AF_INET6 if ":" in host else socket.AF_INET, host, port)
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or "is not a port"
        where = f"port {port}" if host == LOOPBACK else f"address {host}, port {port}"
        raise ConfigError(f"{where}: {reason}; choose another with --port") from None
    if host != LOOPBACK:
        return [first], False
    try:
        return [first, _listener(socket.AF_INET6, "::1", first.getsockname()[1])], True
    except OSError as error:
        return [first], error.errno not in (errno.EADDRINUSE, errno.EACCES)


def _listener(family: socket.AddressFamily, host: str, port: int) -> socket.socket:
    # With the protocol, as asyncio sets TCP_NODELAY only then.
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        if os.name == "posix":
            # Otherwise a port that was just closed stays taken for a minute.
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((host, port))
        listener.listen(128)
    except BaseException:
        listener.close()
        raise
    listener.setblocking(False)
    return listener


def check_port(port: int) -> None:
    """Check that a port is free, before anything is compiled for a page on it; raises as `listen`."""
    for listener in listen(port)[0]:
        listener.close()


MAX_FORMER_SESSIONS = 8
"""Earlier sessions at a port whose open pages return to the present one."""


class FormerSessions:
    """Digests of the cookies of earlier sessions at a port, in a file of this user."""

    def __init__(self, port: int) -> None:
        root = os.environ.get("XDG_RUNTIME_DIR") or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        self._file = Path(root) / "nisus" / f"sessions-{port}"

    def digests(self) -> list[str]:
        """Return those of the last sessions, the newest first; none from a file that others may write."""
        try:
            found = self._file.lstat()
            if os.name == "posix" and (found.st_uid != os.getuid() or found.st_mode & 0o077):
                return []
            return [line for line in self._file.read_text("ascii").split() if len(line) == 64][:MAX_FORMER_SESSIONS]
        except (OSError, ValueError):
            return []

    def keep(self, digests: Sequence[str]) -> None:
        """Write them; without the file, a page opened before needs the new address."""
        part = self._file.with_name(f"{self._file.name}.{secrets.token_hex(4)}")
        with contextlib.suppress(OSError):
            self._file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            # For this user only, from the start.
            with os.fdopen(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
                file.write("\n".join(digests[:MAX_FORMER_SESSIONS]))
            os.replace(part, self._file)


class Auditor(Protocol):
    """Takes the requests that changed something."""

    def revision(self) -> int | None:
        """Return the revision that is shown; None if there are several twins."""

    def add(self, user: User, path: str, body: Mapping[str, object], revision: int | None = None) -> None:
        """Note a request that was carried out; `revision` was shown when it arrived, by default that of now."""


class ShownApplication:
    """An application of the server; `boot` distinguishes it from those before."""

    def __init__(self, application: ASGIApp, boot: str, audit: Auditor | None = None) -> None:
        self.application, self.boot, self.audit = application, boot, audit
        self.replaced = asyncio.Event()
        """Set in the server's thread when another application has taken its place."""
        self.disconnected = threading.Event()
        """Set when the replaced application has no open connection left."""
        self._open = 0

    async def stream(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve a WebSocket until the application is replaced."""

        async def receive_until_replaced() -> Message:
            message, end = asyncio.ensure_future(receive()), asyncio.ensure_future(self.replaced.wait())
            try:
                await asyncio.wait({message, end}, return_when=asyncio.FIRST_COMPLETED)
                return message.result() if message.done() else {"type": "websocket.disconnect", "code": SERVICE_RESTART}
            finally:
                message.cancel()
                end.cancel()

        self._open += 1
        try:
            await self.application(scope, receive_until_replaced, send)
        finally:
            self._open -= 1
            self._check()

    def replace(self) -> None:
        """Give way to another application; in the server's thread."""
        self.replaced.set()
        self._check()

    def _check(self) -> None:
        if self.replaced.is_set() and not self._open:
            self.disconnected.set()


class HttpServer:
    """Serves its own routes, then the present application, in a thread."""

    def __init__(
        self,
        port: int,
        grants: Sequence[Grant] = (),
        *,
        host: str = LOOPBACK,
        public: str | None = None,
        overview: str | None = None,
        site: str | None = None,
    ) -> None:
        """Take the port; 0 takes a free one.

        Args:
            port: The port.
            grants: Tokens of other programs, and of users.
            host: Address to listen on.
            public: Address, https://HOST, at which a reverse proxy offers the page.
            overview: Address of the overview of a service, which passes requests on to this port.
            site: Address of the page at that service.

        Raises:
            ConfigError: If the port is not free.
        """
        self.sockets, localhost = listen(port, host)
        self.port = int(self.sockets[0].getsockname()[1])
        self.site = site or public or f"http://{LOOPBACK}:{self.port}"
        """Address of the page for users, without the token."""
        self.token = secrets.token_urlsafe(32)
        self._shown = ShownApplication(self._no_twin, uuid.uuid4().hex)
        self._page: ASGIApp | None = None
        self._own = Starlette(routes=[Route("/healthz", _alive)])
        self._own.router.default = self._behind
        self._own.router.redirect_slashes = False
        self._loop: asyncio.AbstractEventLoop | None = None
        former = FormerSessions(port) if port else None  # a free port is another one next time
        known = former.digests() if former is not None else []
        access = AccessControl(
            with_security_headers(self._enter, self.port, public), self.token, self.port, known, grants,
            addresses=host != LOOPBACK, public=public,
        )  # fmt: skip
        if former is not None:
            former.keep([access.digest, *known])
        self.entered = access.entered
        self.overview = overview
        self.scene_pass = access.scene_pass if localhost and overview is None else None
        """Pass of the scene for a frame under `localhost`; None where that may be another program."""
        config = uvicorn.Config(
            access, log_config=None, log_level="critical", access_log=False,
            server_header=False, lifespan="off", ws_per_message_deflate=False, timeout_graceful_shutdown=1,
            http=BoundedProtocol, backlog=BACKLOG,
        )  # fmt: skip
        self._server = UvicornServer(config)
        self._thread = LoopThread(functools.partial(self._server.run, sockets=self.sockets), "page server")

    @property
    def url(self) -> str:
        """Address of the page, with its token."""
        return f"http://127.0.0.1:{self.port}/?token={self.token}"

    @property
    def boot(self) -> str:
        """Identity of the application that is shown: a page of another one reloads."""
        return self._shown.boot

    @property
    def has_gallery(self) -> bool:
        """Whether it has routes of its own."""
        return self._page is not None

    @property
    def routes(self) -> list[BaseRoute]:
        """Routes of its own."""
        return list(self._own.router.routes)

    @property
    def boot_without_twin(self) -> str:
        """The same while no twin is shown, else "": a gallery at the address of a twin that came since reloads."""
        shown = self._shown
        return shown.boot if shown.application == self._no_twin else ""

    def add_gallery(self, routes: Sequence[BaseRoute], page: ASGIApp) -> None:
        """Add routes that are always served, and the page for when no twin runs; before the start."""
        self._own.router.routes.extend(routes)
        self._page = page

    def show(
        self, application: ASGIApp | None, boot: str | None = None, audit: Auditor | None = None
    ) -> threading.Event:
        """Show another application, or none; from any thread. Its `audit` gets requests that change settings.

        Returns:
            An event that is set once the previous application has no connection left.
        """
        before = self._shown
        boot = uuid.uuid4().hex if boot is None else boot
        self._shown = ShownApplication(self._no_twin if application is None else application, boot, audit)
        if self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(before.replace)
        else:
            before.disconnected.set()
        return before.disconnected

    def start(self) -> None:
        """Serve."""
        self._thread.start()
        while not self._server.started and self._thread.is_alive():
            time.sleep(0.005)

    def stop(self) -> None:
        """Close all connections, and the port."""
        self._server.end()
        self._thread.stop(5.0)
        for listener in self.sockets:
            listener.close()

    async def _enter(self, scope: Scope, receive: Receive, send: Send) -> None:
        self._loop = asyncio.get_running_loop()
        audit = self._shown.audit
        if audit is not None and scope["type"] == "http" and scope["method"] == "POST" and changes(scope["path"]):
            await _audited(audit, self._own, scope, receive, send)
        else:
            await self._own(scope, receive, send)

    async def _behind(self, scope: Scope, receive: Receive, send: Send) -> None:
        shown = self._shown
        scope.pop("router", None)
        serve = shown.stream if scope["type"] == "websocket" else shown.application
        await serve(scope, receive, send)

    async def _no_twin(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer while no twin runs: a page that still shows one reloads, others get the reason."""
        if scope["type"] == "websocket":
            browser = WebSocket(scope, receive, send)
            await browser.accept()
            await browser.send_json({"boot": self.boot})
            await browser.close(SERVICE_RESTART)
        elif scope["path"] == "/" and self._page is not None:
            await self._page(scope, receive, send)
        elif scope["path"].startswith("/api/"):
            await JSONResponse({"error": NO_TWIN}, 409)(scope, receive, send)
        else:
            await PlainTextResponse(f"Nisus: {NO_TWIN}.\n", 404)(scope, receive, send)


async def _audited(audit: Auditor, application: ASGIApp, scope: Scope, receive: Receive, send: Send) -> None:
    """Serve a request, and note it if it was carried out; of its body only an object that a route has parsed."""
    # By the time of the answer the history may have been folded again with what it changed.
    revision = audit.revision()

    async def send_and_note(message: Message) -> None:
        if message["type"] == "http.response.start" and message["status"] < 400:
            found, size = scope.get(PARSED_BODY, (None, 0))
            fields = found if isinstance(found, dict) else dict(QueryParams(scope["query_string"]))
            if size > MAX_NOTED_BYTES:
                fields = {"command": fields.get("command"), "bytes": size}
            audit.add(scope.get(USER) or User(SESSION, "", ""), scope["path"], fields, revision)
        await send(message)

    await application(scope, receive, send_and_note)


async def _alive(request: Request) -> PlainTextResponse:
    """Answer that the process serves, whatever its twin does."""
    return PlainTextResponse("ok\n")


class UvicornServer(uvicorn.Server):
    """uvicorn's server, which looks once a second whether it is to end, not ten times."""

    _end: Callable[[], object] = staticmethod(lambda: None)

    async def main_loop(self) -> None:
        """Serve until `end` is called."""
        ended, loop = asyncio.Event(), asyncio.get_running_loop()
        to_thread.current_default_thread_limiter().total_tokens = REQUEST_THREADS
        self._end = functools.partial(loop.call_soon_threadsafe, ended.set)
        while not await self.on_tick(0):  # 0: with the date of the answers
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(ended.wait(), 1.0)

    def end(self) -> None:
        """Close all connections; from any thread."""
        self.should_exit = True
        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._end()


class BoundedProtocol(H11Protocol):
    """uvicorn's HTTP with a timeout for each request and a limit of connections, which uvicorn lacks."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Take the connection; if there are too many, the address with most idle ones loses its oldest of them."""
        super().connection_made(transport)
        self._since = self.loop.time()
        self._deadline: asyncio.TimerHandle | None = None
        self._watch()
        there = [other for other in self.connections if not other.transport.is_closing()]  # type: ignore[union-attr]
        if len(there) > MAX_CONNECTIONS:
            idle = [other for other in there if isinstance(other, BoundedProtocol) and other._idle(self)]
            crowd = Counter(other._address for other in idle)
            min(idle, key=lambda other: (-crowd[other._address], other._since), default=self).transport.abort()

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

    @property
    def _address(self) -> str:
        return self.client[0] if self.client else ""

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
