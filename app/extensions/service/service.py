"""A service of several twins behind one port: each in a process of its own, with the gallery as overview.

A twin whose model loops, crashes or takes all memory affects no other one. Its process is started again, later after
each failure.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Protocol
from urllib.parse import quote

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.routing import BaseRoute, Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket

from app.result import JsonObject
from app.terminal import print_line
from app.web.access import USER, User
from app.web.http import PAGE, get, page_file, post, refusal
from app.web.http_server import HttpServer
from app.web.request_threads import in_thread
from app.web.viser_proxy import couple
from config.yaml_files import yaml_files
from estimators.errors import ConfigError, is_blank, nearest, quoted

from .forward import Forwarded, credentials
from .supervisor import FAILED, FIRST_RETRY_S, RUNNING, STARTING, STOPPED, ServedTwin, Supervisor

BLANK = "a twin has the name of its file, which is blank; rename it"
"""Rule of a file whose name cannot be seen."""

MAX_OPENED = 4
"""Twins that run because their page was opened."""

MAX_OPENING_S, OPENING_POLL_S = 30.0, 0.01
"""Longest wait of a page that is opened for its twin, and between two looks."""


class Overview(Protocol):
    """Overview of many more twins than run: each is started when its page is opened."""

    def routes(self) -> list[BaseRoute]:
        """Return its routes."""

    def page(self, boot: str) -> Response:
        """Answer with its page."""

    def find(self, name: str) -> str | None:
        """Return the path of the twin of a name, None if there is none."""

    def unready(self) -> str:
        """Return why it is not ready, or empty."""


class Service:
    """Starts the processes of twins, watches them, and serves their overview and pages."""

    def __init__(self, supervisor: Supervisor, *, http_server: HttpServer, overview: Overview | None = None) -> None:
        """Add the routes to the server; nothing runs yet.

        Args:
            supervisor: Starts the twins; with an overview on demand.
            http_server: Serves the overview.
            overview: In place of the gallery, and of the twins.
        """
        self.http_server, self._overview, self._supervisor = http_server, overview, supervisor
        self.twins = supervisor.twins
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
        http_server.add_gallery(routes, Starlette(routes=[get("/", self._page)]))
        http_server.show(None, audit=self)

    # From any thread

    def start(self) -> None:
        """Begin."""
        self._supervisor.start()
        self.http_server.start()

    def stop(self) -> None:
        """Stop all twins, concurrently, and the port."""
        self._supervisor.stop()
        self.http_server.stop()

    def revision(self) -> None:
        """A service has twins, of which each has its revisions."""

    def add(self, user: User, path: str, body: Mapping[str, object], revision: int | None = None) -> None:
        """Pass a request that starts or stops a twin on to the audit log of that."""
        twin = self.twins.get(str(body.get("twin", "")))
        if twin is not None and path.startswith("/api/gallery/"):
            self._supervisor.note(twin, (tuple(user), path, {}))

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
            return self._overview.page(self.http_server.boot)
        return page_file("gallery.html", {"boot": self.http_server.boot, "service": True}, title="Overview")

    def state(self) -> JsonObject:
        """Return the state of each twin, the worst first."""
        twins = sorted(self.twins.values(), key=lambda twin: twin.rank)
        idle = {"running": None, "starting": None, "failed": None}
        return {"boot": self.http_server.boot, **idle, "twins": [twin.json() for twin in twins]}

    def _cards(self) -> list[JsonObject]:
        """Return a card for each twin."""
        unknown = {"question": None, "teaches": None, "source": "", "states": 0, "rows": 0, "estimator": ""}
        unknown |= {"log": False, "picture": False, "missing": None, "error": None}
        return [{**unknown, "title": twin.name, **twin.card, "name": name} for name, twin in self.twins.items()]

    def _ready(self, request: Request) -> Response:
        """Answer 200 once all twins that are not stopped run, or the overview is ready, else 503; why with a token."""
        reason = self._unready() if self._overview is None else self._overview.unready()
        if reason:
            return PlainTextResponse(f"{reason if USER in request.scope else 'not ready'}\n", 503)
        return PlainTextResponse("ok\n")

    def _unready(self) -> str:
        missing = [twin.name for twin in self.twins.values() if twin.wanted and twin.state != RUNNING]
        return f"{len(missing)} twin(s) do not run: {', '.join(missing[:20])}" if missing else ""

    def _start(self, twin: str) -> JsonObject:
        """Begin to start a stopped twin."""
        found = self.find(twin)
        with self._supervisor.changing:
            found.wanted = True
            if found.state in (STOPPED, FAILED):
                found.state, found.due, found.wait = STARTING, 0.0, FIRST_RETRY_S
        return self.state()

    def _stop(self, twin: str) -> JsonObject:
        """Begin to stop a twin; the others go on."""
        found = self.find(twin)
        with self._supervisor.changing:
            found.wanted = False
            if found.process is None:
                found.state, found.text = STOPPED, ""
            self._supervisor.ask_to_stop(found)
        return self.state()

    def _restart(self, twin: str) -> JsonObject:
        """Begin to stop a twin and to start it anew, with its file as it is now."""
        found = self.find(twin)
        with self._supervisor.changing:
            found.wanted, found.due, found.wait = True, 0.0, 0.0
            if found.process is None:
                found.state = STARTING
            self._supervisor.ask_to_stop(found)
        return self.state()

    async def _slash(self, request: Request) -> Response:
        # The dot: a name such as https:there would be the address of another site.
        return RedirectResponse(f"./{quote(request.path_params['name'], safe='')}/", 308)

    async def _elsewhere(self, request: Request) -> Response:
        text = f"this is a service of several twins, whose interfaces are at /twins/NAME/{request.url.path.lstrip('/')}"
        return refusal(ConfigError(f"{text}; NAME is one of {', '.join([*self.twins][:20])}"), 404)

    async def _forward(self, request: Request) -> Response | Forwarded:
        twin = self.twins.get(request.path_params["name"])
        if self._overview is not None and not request.path_params["path"]:
            twin = await self._opened(request.path_params["name"])
        if twin is None or not twin.port:
            reason = "is no twin of this service" if twin is None else f"is {twin.state}"
            if twin is not None and self._overview is not None and twin.text:
                reason = f"cannot be opened: {twin.text}"
            return PlainTextResponse(f"Nisus: {request.path_params['name']} {reason}.\n", 404 if twin is None else 503)
        return Forwarded(twin, "/" + request.path_params["path"])

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
        with self._supervisor.changing:
            twin = self.twins.pop(name, None)
            if path is None or (twin is not None and not twin.wanted):
                if twin is not None:
                    self.twins[name] = twin
                return twin
            for other in list(self.twins.values())[: max(0, len(self.twins) + 1 - MAX_OPENED)]:
                other.wanted = False
                self._supervisor.ask_to_stop(other)
            self.twins[name] = twin or ServedTwin(name, path)  # the one that was asked for last is last
            if twin is None:
                self._supervisor.begin(self.twins[name])
            return self.twins[name]

    async def _couple(self, browser: WebSocket) -> None:
        twin = self.twins.get(browser.path_params["name"])
        if twin is None or not twin.port:
            await browser.close(1013)
            return
        query = browser.scope["query_string"].decode("latin-1")
        url = f"ws://127.0.0.1:{twin.port}/{quote(browser.path_params['path'])}" + (f"?{query}" if query else "")
        headers = {name.decode(): value.decode("latin-1") for name, value in credentials(twin, browser.scope)}
        await couple(browser, url, headers, origin=f"http://127.0.0.1:{twin.port}")


class TwinFolder:
    """Folder of YAML files. Of two files of one name the first that was found is a twin, the other one line."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._known: dict[str, Path] = {}
        self._refused: set[Path] = set()

    def __call__(self) -> dict[str, str]:
        """Return the present paths of the twins by name."""
        files = yaml_files(self._folder)
        self._known = {name: path for name, path in self._known.items() if path in files}
        for path in files:
            blank = is_blank(path.stem)
            known = path if blank else self._known.setdefault(path.stem, path)
            if (blank or path != known) and path not in self._refused:
                rule = BLANK if blank else f"{known.name} is a twin of this name already; rename the file"
                print_line("error", f"{quoted(str(path)) if blank else path}: {rule}")
                self._refused.add(path)
        return {name: str(path) for name, path in sorted(self._known.items())}
