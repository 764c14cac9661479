"""A service of several twins behind one port: each in a process of its own, with the gallery as overview.

A twin whose model loops, crashes or takes all memory affects no other one. Its process is started again, later after
each failure.
"""

from __future__ import annotations

import asyncio
import multiprocessing
import signal
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing import forkserver
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import quote

import h11
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.routing import BaseRoute, Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.types import Receive, Scope, Send
from starlette.websockets import WebSocket

from estimators.errors import ConfigError, nearest, quoted
from estimators.track import HEALTH_NAMES

from ..terminal import print_line
from .door import Door
from .gate import USER, User
from .http import PAGE, get, page_file, post, refusal
from .request_threads import in_thread
from .viser_proxy import couple

STARTING, RUNNING, STOPPED, FAILED = "starting", "running", "stopped", "failed"
"""States of a twin's process."""

STATUS_PERIOD_S = 1.0
"""Seconds between two reports of a twin to the service."""

MAX_SILENCE_S = 30.0
"""Seconds without a report after which a running process is killed and started again."""

MAX_START_S = 900.0
"""The same while it starts, which may compile filters."""

STOP_TIMEOUT_S = 10.0
"""Seconds for which a process may write its store and recording."""

FIRST_RETRY_S, MAX_RETRY_S = 1.0, 60.0
"""Wait before a process that has ended is started again: doubled after each failure, and at most."""

STEADY_S = 30.0
"""A process that ran for so long begins with the first wait again."""

FOLDER_PERIOD_S = 2.0
"""Seconds between two looks at the folder of twins."""

MAX_OPENED = 4
"""Twins that run because their page was opened."""

MAX_OPENING_S, OPENING_POLL_S = 30.0, 0.01
"""Longest wait of a page that is opened for its twin, and between two looks."""

PIECE_BYTES = 65_536

HOP_HEADERS = (
    b"connection", b"keep-alive", b"transfer-encoding", b"upgrade", b"set-cookie", b"content-security-policy", b"date"
)  # fmt: skip
"""Headers of answers that are not passed on."""

REQUEST_HEADERS = (
    b"accept", b"accept-encoding", b"content-type", b"content-length", b"if-none-match", b"if-range", b"range",
    b"last-event-id",
)  # fmt: skip
"""Headers of requests that are passed on; the service has judged host, origin and token."""


@dataclass
class ServedTwin:
    """A twin of the service, and its process.

    `text` is the reason of a failure, `failure` that of the last one. `card` describes the twin, once it has been read,
    and `report` its estimate. `noted` are requests for its audit log, which wait until it runs.
    """

    name: str
    path: str
    state: str = STARTING
    text: str = ""
    failure: str = ""
    wanted: bool = True
    process: multiprocessing.process.BaseProcess | None = None
    pipe: Connection | None = None
    port: int = 0
    token: str = ""
    began: float = 0.0
    heard: float = 0.0
    due: float = 0.0
    wait: float = FIRST_RETRY_S
    starts: int = 0
    card: Mapping[str, Any] = field(default_factory=dict)
    report: Mapping[str, Any] = field(default_factory=dict)
    noted: list[tuple[Any, ...]] = field(default_factory=list)

    @property
    def rank(self) -> tuple[int, str]:
        """Place in the overview: the worst first."""
        if self.state == STOPPED:
            return len(HEALTH_NAMES) + 1, self.name
        if self.state != RUNNING:
            return (-2 if self.state == FAILED else 0), self.name
        health = self.report.get("health", "")
        order = ("diverged", "stale", "degraded", "suspect", "advisory", "waiting", "tracking")
        return order.index(health) - 1 if health in order else 0, self.name

    def json(self) -> dict[str, Any]:
        """Return its state for the overview."""
        now = time.monotonic()
        return {
            "name": self.name,
            "state": self.state,
            "text": self.text,
            "starts": self.starts,
            "pid": None if self.process is None else self.process.pid,
            "seconds": round(now - self.began, 1),
            "again_in": round(max(0.0, self.due - now), 1) if self.state == FAILED and self.wanted else None,
            **self.report,
        }


Child = Callable[[str, str, Connection], None]
"""Runs a twin, given its name, path and a pipe, in a process of its own."""


class Overview(Protocol):
    """Overview of many more twins than run: each is started when its page is opened."""

    def routes(self) -> list[BaseRoute]:
        """Return its routes."""

    def page(self, boot: str) -> Response:
        """Answer with its page."""

    def find(self, name: str) -> str | None:
        """Return the path of the twin of a name, None if there is none."""


class Service:
    """Starts the processes of twins, watches them, and serves their overview and pages."""

    def __init__(
        self,
        twins: Mapping[str, str],
        child: Child,
        *,
        door: Door,
        folder: Callable[[], Mapping[str, str]] | None = None,
        preload: Sequence[str] = (),
        at_once: int = 2,
        overview: Overview | None = None,
    ) -> None:
        """Add the routes to the door; nothing runs yet.

        Args:
            twins: Paths of the twins by name.
            child: Runs one of them.
            door: Serves the overview.
            folder: Returns the twins of a folder, which are added and removed as its files are.
            preload: Modules that the processes share.
            at_once: Twins that start at the same time.
            overview: In place of the gallery, and of the twins.
        """
        self.door, self._child, self._folder, self._at_once = door, child, folder, at_once
        self.twins = {name: ServedTwin(name, path) for name, path in twins.items()}
        self._overview = overview
        self._changing = threading.RLock()
        self._stopping = threading.Event()
        self._looked = time.monotonic()
        methods = multiprocessing.get_all_start_methods()
        self._context: Any = multiprocessing.get_context("forkserver" if "forkserver" in methods else "spawn")
        if preload and "forkserver" in methods:
            self._context.set_forkserver_preload(list(preload))
        self._thread = threading.Thread(target=self._watch, name="service", daemon=True)
        routes = [
            get("/gallery", self._page),
            get("/readyz", self._ready),
            Mount("/page", StaticFiles(directory=PAGE)),
            get("/api/session", self.state),
            *(self._gallery() if overview is None else overview.routes()),
            Route("/twins/{name}", self._slash),
            Route("/twins/{name}/{path:path}", self._forward, methods=["GET", "HEAD", "POST"]),
            WebSocketRoute("/twins/{name}/{path:path}", self._couple),
            Route("/api/{path:path}", self._elsewhere, methods=["GET", "POST"]),
        ]
        door.add_gallery(routes, Starlette(routes=[get("/", self._page)]))
        door.show(None, audit=self)

    # From any thread

    def start(self) -> None:
        """Begin."""
        if self._overview is not None and self._context.get_start_method() == "forkserver":
            forkserver.ensure_running()  # so that it has the modules when the first page is opened
        self.door.start()
        self._thread.start()

    def stop(self) -> None:
        """Stop all twins, concurrently, and the port."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join(5.0)
        for twin in self.twins.values():
            self._ask_to_stop(twin)
        end = time.monotonic() + STOP_TIMEOUT_S
        for twin in self.twins.values():
            self._end(twin, end)
        self.door.stop()

    def add(self, user: str, role: str, address: str, path: str, body: Mapping[str, Any]) -> None:
        """Pass a request that starts or stops a twin on to the audit log of that."""
        twin = self.twins.get(str(body.get("twin", "")))
        if twin is not None and path.startswith("/api/gallery/"):
            with self._changing:
                twin.noted.append((user, role, address, path, {}))
                self._send_noted(twin)

    def _send_noted(self, twin: ServedTwin) -> None:
        if twin.pipe is not None and twin.port:
            with suppress(OSError, ValueError):
                for entry in twin.noted:
                    twin.pipe.send(("audit", entry))
            twin.noted.clear()

    def find(self, name: str) -> ServedTwin:
        """Return a twin.

        Raises:
            ConfigError: If there is none of that name.
        """
        found = self.twins.get(name)
        if found is None:
            raise ConfigError(f"{quoted(name)} is no twin of this service; {nearest(name, self.twins)}")
        return found

    # Requests

    def _gallery(self) -> list[BaseRoute]:
        return [
            get("/api/gallery", self._cards),
            post("/api/gallery/start", self._start, status=202),
            post("/api/gallery/stop", self._stop, status=202),
            post("/api/gallery/restart", self._restart, status=202),
        ]

    def _page(self) -> Response:
        """Answer with the overview."""
        if self._overview is not None:
            return self._overview.page(self.door.boot)
        return page_file("gallery.html", {"boot": self.door.boot, "service": True}, title="Overview")

    def state(self) -> dict[str, Any]:
        """Return the state of each twin, the worst first."""
        twins = sorted(self.twins.values(), key=lambda twin: twin.rank)
        idle = {"running": None, "starting": None, "failed": None}
        return {"boot": self.door.boot, **idle, "twins": [twin.json() for twin in twins]}

    def _cards(self) -> list[dict[str, Any]]:
        """Return a card for each twin."""
        unknown = {"question": None, "teaches": None, "source": "", "states": 0, "rows": 0, "estimator": ""}
        unknown |= {"log": False, "picture": False, "missing": None, "error": None}
        return [{**unknown, "title": twin.name, **twin.card, "name": name} for name, twin in self.twins.items()]

    def _ready(self, request: Request) -> Response:
        """Answer 200 once all twins that are not stopped run, else 503; with a token also the names of the others."""
        watched = self.twins.values() if self._overview is None else ()
        missing = [twin.name for twin in watched if twin.wanted and twin.state != RUNNING]
        if missing:
            names = f"{len(missing)} twin(s) do not run: {', '.join(missing[:20])}"
            return PlainTextResponse(f"{names if USER in request.scope else 'not ready'}\n", 503)
        return PlainTextResponse("ok\n")

    def _start(self, twin: str) -> Any:
        """Begin to start a stopped twin."""
        found = self.find(twin)
        with self._changing:
            found.wanted = True
            if found.state in (STOPPED, FAILED):
                found.state, found.due, found.wait = STARTING, 0.0, FIRST_RETRY_S
        return self.state()

    def _stop(self, twin: str) -> Any:
        """Begin to stop a twin; the others go on."""
        found = self.find(twin)
        with self._changing:
            found.wanted = False
            if found.process is None:
                found.state, found.text = STOPPED, ""
            self._ask_to_stop(found)
        return self.state()

    def _restart(self, twin: str) -> Any:
        """Begin to stop a twin and to start it anew, with its file as it is now."""
        found = self.find(twin)
        with self._changing:
            found.wanted, found.due, found.wait = True, 0.0, 0.0
            if found.process is None:
                found.state = STARTING
            self._ask_to_stop(found)
        return self.state()

    async def _slash(self, request: Request) -> Response:
        # The dot: a name such as https:there would be the address of another site.
        return RedirectResponse(f"./{quote(request.path_params['name'], safe='')}/", 308)

    async def _elsewhere(self, request: Request) -> Response:
        text = f"this is a service of several twins, whose interfaces are at /twins/NAME/{request.url.path.lstrip('/')}"
        return refusal(ConfigError(f"{text}; NAME is one of {', '.join([*self.twins][:20])}"), 404)

    async def _forward(self, request: Request) -> Response | _Forwarded:
        twin = self.twins.get(request.path_params["name"])
        if self._overview is not None and not request.path_params["path"]:
            twin = await self._opened(request.path_params["name"])
        if twin is None or not twin.port:
            reason = "is no twin of this service" if twin is None else f"is {twin.state}"
            if twin is not None and self._overview is not None and twin.text:
                reason = f"cannot be opened: {twin.text}"
            return PlainTextResponse(f"Nisus: {request.path_params['name']} {reason}.\n", 404 if twin is None else 503)
        return _Forwarded(twin, "/" + request.path_params["path"])

    async def _opened(self, name: str) -> ServedTwin | None:
        """Return the twin of a page that is opened, once it runs or has failed; None if there is none."""
        twin = await in_thread(lambda: self._ask_for(name))
        end = time.monotonic() + MAX_OPENING_S
        while twin is not None and twin.state == STARTING and time.monotonic() < end:
            await asyncio.sleep(OPENING_POLL_S)
        return twin

    def _ask_for(self, name: str) -> ServedTwin | None:
        """Return a twin that runs or starts on demand; those whose pages were opened first make room."""
        assert self._overview is not None
        path = self._overview.find(name)
        with self._changing:
            twin = self.twins.pop(name, None)
            if path is None or (twin is not None and not twin.wanted):
                if twin is not None:
                    self.twins[name] = twin
                return twin
            for other in list(self.twins.values())[: max(0, len(self.twins) + 1 - MAX_OPENED)]:
                other.wanted = False
                self._ask_to_stop(other)
            self.twins[name] = twin or ServedTwin(name, path)  # the one that was asked for last is last
            if twin is None:
                self._begin(self.twins[name])
            return self.twins[name]

    async def _couple(self, browser: WebSocket) -> None:
        twin = self.twins.get(browser.path_params["name"])
        if twin is None or not twin.port:
            await browser.close(1013)
            return
        query = browser.scope["query_string"].decode("latin-1")
        url = f"ws://127.0.0.1:{twin.port}/{quote(browser.path_params['path'])}" + (f"?{query}" if query else "")
        headers = {name.decode(): value.decode("latin-1") for name, value in _credentials(twin, browser.scope)}
        await couple(browser, url, headers, origin=f"http://127.0.0.1:{twin.port}")

    # In the service's thread

    def _watch(self) -> None:
        while not self._stopping.is_set():
            twins = list(self.twins.values())
            pipes: dict[Any, ServedTwin] = {twin.pipe: twin for twin in twins if twin.pipe is not None}
            waited: list[Any] = [*pipes, *(twin.process.sentinel for twin in twins if twin.process is not None)]
            for pipe in set(wait(waited, 0.2)) & set(pipes) if waited else self._rest():
                self._listen(pipes[pipe])
            with self._changing:
                self._look()

    def _rest(self) -> set[Any]:
        self._stopping.wait(0.2)
        return set()

    def _listen(self, twin: ServedTwin) -> None:
        """Take a message of a twin's process: (kind, content)."""
        assert twin.pipe is not None
        try:
            kind, content = twin.pipe.recv()
        except (EOFError, OSError):
            twin.pipe.close()
            twin.pipe = None
            return
        twin.heard = time.monotonic()
        if kind == "ready":
            twin.port, twin.token, twin.card = content
            twin.state, twin.text = RUNNING, ""
            with self._changing:
                self._send_noted(twin)
        elif kind == "report":
            twin.report = content
        elif kind == "failed":
            twin.text = content

    def _look(self) -> None:
        """Start processes that are due, and note those that have ended."""
        now = time.monotonic()
        if self._folder is not None and now - self._looked > FOLDER_PERIOD_S:
            self._looked = now
            self._look_at_folder(self._folder())
        starting = sum(twin.process is not None and twin.state == STARTING for twin in self.twins.values())
        for twin in list(self.twins.values()):
            if twin.process is None:
                if twin.wanted and now >= twin.due and starting < self._at_once:
                    self._begin(twin)
                    starting += 1
            elif not twin.process.is_alive():
                self._note_end(twin)
            elif now - twin.heard > (MAX_SILENCE_S if twin.state == RUNNING else MAX_START_S):
                twin.text = f"did not answer for {now - twin.heard:.0f} s"
                twin.process.kill()

    def _look_at_folder(self, found: Mapping[str, str]) -> None:
        for name, path in found.items():
            if name not in self.twins:
                print_line("info", "was added to the folder", twin=name)
                self.twins[name] = ServedTwin(name, path)
        for name in [name for name in self.twins if name not in found]:
            twin = self.twins[name]
            twin.wanted = False
            self._ask_to_stop(twin)
            if twin.process is None:
                print_line("info", "was removed from the folder", twin=name)
                del self.twins[name]

    def _begin(self, twin: ServedTwin) -> None:
        ours, its = self._context.Pipe()
        twin.process = self._context.Process(target=self._child, args=(twin.name, twin.path, its), name=twin.name)
        twin.pipe, twin.state = ours, STARTING
        twin.began = twin.heard = time.monotonic()
        twin.starts += 1
        twin.process.start()
        its.close()

    def _note_end(self, twin: ServedTwin) -> None:
        """Note that a process has ended; unless it was asked to, it is started again."""
        assert twin.process is not None
        while twin.pipe is not None and twin.pipe.poll():
            self._listen(twin)
        ran, code = time.monotonic() - twin.began, twin.process.exitcode or 0
        twin.process.close()
        if twin.pipe is not None:
            twin.pipe.close()
        twin.process, twin.pipe, twin.port, twin.report = None, None, 0, {}
        if self._overview is not None:  # opened on demand, and again when its page is asked for
            twin.state = FAILED if twin.wanted else STOPPED
            twin.text = twin.text or (f"ended by {_signal_name(-code)}" if code < 0 else f"ended with status {code}")
            del self.twins[twin.name]
            return
        if not twin.wanted:
            twin.state, twin.text = STOPPED, ""
            print_line("info", "stopped", twin=twin.name)
            return
        if twin.wait == 0.0:  # asked to
            twin.state, twin.wait = STARTING, FIRST_RETRY_S
            print_line("info", "stopped, to be started anew", twin=twin.name)
            return
        why = twin.text or (f"ended by {_signal_name(-code)}" if code < 0 else f"ended with status {code}")
        twin.wait = FIRST_RETRY_S if ran > STEADY_S else twin.wait
        twin.due = time.monotonic() + twin.wait
        if why != twin.failure or ran > STEADY_S:  # one that cannot start at all is one line
            print_line("error", f"{why}; started again in {twin.wait:.0f} s, then less often", twin=twin.name)
        twin.failure = why
        twin.state, twin.text, twin.wait = FAILED, why, min(MAX_RETRY_S, 2 * twin.wait)

    def _ask_to_stop(self, twin: ServedTwin) -> None:
        if twin.pipe is not None:
            with suppress(OSError, ValueError):
                twin.pipe.send(("stop", None))

    def _end(self, twin: ServedTwin, end: float) -> None:
        """Wait for a process until some time, then kill it."""
        if twin.process is None:
            return
        twin.process.join(max(0.0, end - time.monotonic()))
        if twin.process.is_alive():
            print_line("error", f"did not stop within {STOP_TIMEOUT_S:g} s; killed", twin=twin.name)
            twin.process.kill()
            twin.process.join()


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


def _credentials(twin: ServedTwin, scope: Scope) -> Iterable[tuple[bytes, bytes]]:
    """Return the headers by which a twin's process accepts a request, with its user."""
    user = scope.get(USER) or User("", "", "")
    return (
        (b"authorization", f"Bearer {twin.token}".encode()),
        (b"nisus-user", " ".join(user).encode("utf-8", "replace")),
    )


class _Forwarded(Response):
    """Answer of a twin's process, piece by piece."""

    def __init__(self, twin: ServedTwin, path: str) -> None:
        self._twin, self._path = twin, path
        self.background = None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, and the answer back, until either side ends."""
        try:
            reader, writer = await asyncio.open_connection("127.0.0.1", self._twin.port)
        except OSError:
            await PlainTextResponse(f"Nisus: {self._twin.name} does not answer.\n", 502)(scope, receive, send)
            return
        sender = asyncio.ensure_future(self._send(scope, receive, writer))
        answer = asyncio.ensure_future(self._answer(scope, reader, send))
        try:
            await asyncio.wait({sender, answer}, return_when=asyncio.FIRST_COMPLETED)
            if sender.done() and sender.result():
                answer.cancel()  # the client has gone
            if not await answer:
                refusal = PlainTextResponse(f"Nisus: {self._twin.name} ended before its answer.\n", 502)
                await refusal(scope, receive, send)
        except asyncio.CancelledError:
            pass
        finally:
            sender.cancel()
            answer.cancel()
            writer.close()

    async def _send(self, scope: Scope, receive: Receive, writer: asyncio.StreamWriter) -> bool:
        """Send the request; return True once the client has gone."""
        target = quote(self._path).encode()
        query = scope["query_string"]
        headers = [(name, value) for name, value in scope["headers"] if name in REQUEST_HEADERS]
        if any(name == b"transfer-encoding" for name, _ in scope["headers"]):  # a body of unknown length
            headers = [item for item in headers if item[0] != b"content-length"]
            headers += [(b"transfer-encoding", b"chunked")]
        headers += [*_credentials(self._twin, scope), (b"host", f"127.0.0.1:{self._twin.port}".encode())]
        headers += [(b"connection", b"close")]
        connection = h11.Connection(h11.CLIENT)
        request = h11.Request(method=scope["method"], target=target + (b"?" + query if query else b""), headers=headers)
        with suppress(OSError, h11.LocalProtocolError):
            writer.write(connection.send(request) or b"")
            while (message := await receive())["type"] == "http.request":
                if message.get("body"):
                    writer.write(connection.send(h11.Data(message["body"])) or b"")
                    await writer.drain()
                if not message.get("more_body"):
                    writer.write(connection.send(h11.EndOfMessage()) or b"")
                    break
        while (await receive())["type"] != "http.disconnect":
            pass
        return True

    async def _answer(self, scope: Scope, reader: asyncio.StreamReader, send: Send) -> bool:
        """Pass the answer back; return whether there was one."""
        connection, begun = h11.Connection(h11.CLIENT), False
        connection.send(h11.Request(method=scope["method"], target="/", headers=[("host", "x")]))
        connection.send(h11.EndOfMessage())
        with suppress(OSError, h11.RemoteProtocolError):
            while True:
                event = connection.next_event()
                if event is h11.NEED_DATA:
                    connection.receive_data(await reader.read(PIECE_BYTES))
                elif isinstance(event, h11.Response):
                    headers = [(name, value) for name, value in event.headers if name not in HOP_HEADERS]
                    await send({"type": "http.response.start", "status": event.status_code, "headers": headers})
                    begun = True
                elif isinstance(event, h11.Data):
                    await send({"type": "http.response.body", "body": bytes(event.data), "more_body": True})
                elif isinstance(event, h11.EndOfMessage):
                    await send({"type": "http.response.body", "body": b"", "more_body": False})
                    return True
                elif isinstance(event, h11.ConnectionClosed):
                    return begun
        return begun


class TwinFolder:
    """Folder of YAML files. Of two files of one name the first that was found is a twin, the other one line."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._known: dict[str, Path] = {}
        self._refused: set[Path] = set()

    def __call__(self) -> dict[str, str]:
        """Return the present paths of the twins by name."""
        files = {path for path in self._folder.glob("*") if path.suffix in (".yaml", ".yml") and path.is_file()}
        self._known = {name: path for name, path in self._known.items() if path in files}
        for path in sorted(files):
            known = self._known.setdefault(path.stem, path)
            if path != known and path not in self._refused:
                print_line("error", f"{path}: {known.name} is a twin of this name already; rename the file")
                self._refused.add(path)
        return {name: str(path) for name, path in sorted(self._known.items())}
