"""Page server of a running twin: the page, its API, its streams, recordings, and Viser behind it."""

from __future__ import annotations

import asyncio
import gzip
import threading
import time
import uuid
from collections.abc import AsyncIterator
from concurrent.futures import Future
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response, StreamingResponse
from starlette.routing import BaseRoute, Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket

from config.extensions import made, maker, registered
from estimators.attribution import attribution
from estimators.errors import ConfigError, EstimatorError, NisusError, reason_of

from ..charts.colors import EITHER, THEMES
from ..charts.series import Series
from ..derive.diagnosis import Diagnosis
from ..derive.forecast import Forecasts
from ..derive.refits import Refits
from ..engine.engine import STATUS_PERIOD_S, Engine
from ..engine.faults import catalogue_json
from ..engine.outputs.alarm_guide import alarms_text, as_html
from ..engine.outputs.alerts import alert_schema
from ..engine.outputs.publisher import ALIVE_PERIOD_S
from ..engine.outputs.state_message import StateMessage, state_message, state_schema
from ..result import JsonObject, plain
from ..study.why import why_json
from ..terminal import messages_file
from . import readings
from .commands_json import command_from_json, commands_schema
from .fit_api import FitApi
from .http import PAGE, OneAtATime, get, one_line, openapi, page_file, post, refusal
from .http_server import HttpServer
from .request_threads import in_rerun_thread, in_thread
from .runs_api import RunsApi
from .streams import PageStream, feed_rerun
from .twin_json import annotations_json, episodes_json, model_json, status_json
from .viewer_assets import FILES, viewer_assets, viewer_version
from .viser_proxy import ViserProxy

if TYPE_CHECKING:
    from ..charts.colors import Palette
    from ..explore.feed import RerunFeed
    from ..scene.renderer import Choices

COMPILE_POLL_PERIOD_S = 0.5
"""Between two looks at whether the first filter is compiled."""

CHART_FILES = sorted(path.name for path in (PAGE / "charts").glob("*.js"))
"""Kinds of charts, one per file."""

NOT_PUBLISHED: JsonObject = {
    "outputs": [], "receivers": [], "alerts": [], "muted_s": 0.0, "mute_reason": "",
}  # fmt: skip
"""Outputs of a recording, which is published nowhere."""

IMMUTABLE = "public, max-age=31536000, immutable"
MEDIA_TYPES = {".js": "text/javascript", ".wasm": "application/wasm"}


def _message(found: StateMessage) -> Response:
    return Response(found.model_dump_json(), media_type="application/json", headers={"Cache-Control": "no-store"})


class PageServer:
    """Serves one engine to any number of browsers, on an HTTP server that may outlive it."""

    def __init__(
        self,
        engine: Engine,
        *,
        port: int | HttpServer,
        viser_port: int | None,
        secret: str,
        review: Path | None = None,
        choices: Choices | None = None,
        refits: Refits | None = None,
    ) -> None:
        """Take the port, if it is not open yet.

        Args:
            engine: The running twin.
            port: On 127.0.0.1; 0 takes a free one. Or an open server, which shows this once it is started.
            viser_port: Port of the private Viser server; None if there is none.
            secret: Secret of the Viser server.
            review: The reviewed recording, offered beside those that this process writes.
            choices: Options of Viser's scene; None if there is no scene.
            refits: Fits of the last window; None for none.

        Raises:
            ConfigError: If the port is not free.
        """
        self._engine, self._review, self._choices = engine, review, choices
        self.series = Series(engine)
        self._runs = RunsApi(engine, self.series)
        self.refits = refits or Refits(engine)
        self._fit = FitApi(engine, self.refits)
        self._forecasts, self._diagnosis = Forecasts(engine), Diagnosis(engine)
        self._boot = uuid.uuid4().hex
        self.unread: str | None = None
        """Why the twin's files, as saved last, could not be read; None if they run."""
        self._own_server = not isinstance(port, HttpServer)
        self.http_server = port if isinstance(port, HttpServer) else HttpServer(port)
        self.port, self.entered = self.http_server.port, self.http_server.entered
        self._assets: Future[Path] = Future()
        self._explored, self._stopping = threading.Event(), threading.Event()
        self._viser = ViserProxy(viser_port, secret) if viser_port is not None else None
        self.application = Starlette(routes=self._routes(), exception_handlers={Exception: self._failed})

    @property
    def url(self) -> str:
        """Address of the page, with its token."""
        return self.http_server.url

    def start(self) -> threading.Event:
        """Serve; return an event that is set once the application before has no connection left."""
        threading.Thread(target=self._prepare_viewer, name="viewer assets", daemon=True).start()
        disconnected = self.http_server.show(self.application, self._boot, self._engine.audit)
        if self._own_server:
            self.http_server.start()
        return disconnected

    def stop(self) -> None:
        """Stop all work, close all connections, and the port if it is this twin's own."""
        self._stopping.set()
        if self._own_server:
            self.http_server.stop()

    def _prepare_viewer(self) -> None:
        """Unpack the Rerun viewer's files, after the first filter is compiled or once a browser opens Explore."""
        while self._engine.status().awaited is not None and not self._explored.is_set():
            if self._stopping.wait(COMPILE_POLL_PERIOD_S):
                return
        try:
            self._assets.set_result(viewer_assets(lambda line: print(line, file=messages_file(), flush=True)))
        except NisusError as error:
            self._assets.set_exception(error)

    def _routes(self) -> list[BaseRoute]:
        routes: list[BaseRoute] = [
            get("/", self._index),
            get("/explore", self._explore),
            get("/alarms", self._alarms),
            get("/readyz", self._ready),
            get("/api/status", self._status),
            get("/api/state", self._state, answer=StateMessage),
            get("/api/state/schema.json", state_schema),
            get("/api/openapi.json", self._openapi),
            Route("/api/state/stream", self._state_stream),
            get("/api/alerts", self._alerts),
            get("/api/alerts/schema.json", alert_schema),
            get("/api/model", self._model),
            get("/api/episodes", self._episodes),
            get("/api/why", self._why, refused=409, run=OneAtATime("attribution")),
            get("/api/annotations", self._annotations),
            get("/api/audit", self._audit),
            get("/api/faults", self._faults),
            *readings.routes(self._engine),
            *self._runs.routes(),
            *self._fit.routes(),
            post("/api/command", self._command, status=202, body_schema=commands_schema),
            get("/api/forecast", self._forecasts.may, refused=409),
            post("/api/forecast", self._forecasts.compute, run=OneAtATime("forecast")),
            get("/api/diagnose", self._diagnosis.figures, refused=503, run=OneAtATime("diagnosis")),
            get("/api/scene", self._scene),
            post("/api/scene", self._choose),
            get("/api/recordings", self._list_recordings),
            get("/panels/{title:path}", self._panel, refused=404),
            get("/rec/{name}", self._recording),
            Route(f"/viewer/{viewer_version()}/{{name}}", self._viewer_file),
            WebSocketRoute("/api/stream", self._page_stream),
            WebSocketRoute("/rerun/stream", self._rerun_stream),
            Mount("/page", StaticFiles(directory=PAGE)),
        ]
        if self._viser is not None:
            routes += [
                WebSocketRoute("/viser/{path:path}", self._viser.websocket),
                WebSocketRoute("/viser", self._viser.websocket),
                Route("/viser/", self._viser.page),
            ]
        return [*routes, *made("routes", self._engine)]

    async def _failed(self, request: Request, error: Exception) -> Response:
        """Report an error of a route, which may be an extension's, and answer with it."""
        path = request.url.path
        owner, _ = registered("routes").get(path, ("", None))
        place = f"extension {owner}: {path} of its routes" if owner else path
        line = one_line(f"{place}: {reason_of(error)}")
        self._engine.notices.report("request failed", line, level="error")
        return refusal(ConfigError(line), 500)

    def _page(self, name: str) -> Response:
        settings = {"viewer": f"viewer/{viewer_version()}", "boot": self._boot, "viser": self._viser is not None}
        server = self.http_server
        settings |= {"charts": CHART_FILES, "gallery": server.has_gallery, "stage_pass": server.scene_pass}
        return page_file(name, settings | {"overview": server.overview, "panels": list(registered("panels"))})

    def _panel(self, title: str) -> Response:
        """Answer with the script of a tab that an extension adds."""
        return Response(str(maker("panels", title, f"the tab {title}")()), media_type="text/javascript")

    def _index(self) -> Response:
        """Answer with the page."""
        return self._page("index.html")

    def _explore(self) -> Response:
        """Answer with a page of the Rerun viewer alone."""
        return self._page("explore.html")

    def _alarms(self) -> Response:
        """Answer with docs/alarms.md, to which episodes refer."""
        try:
            text = as_html(alarms_text())
        except ConfigError as error:
            return PlainTextResponse(f"Nisus: {error}\n", 404)
        return page_file("alarms.html", {}, text=text)

    def _status(self) -> JsonObject:
        """Return the state of the twin."""
        return status_json(self._engine) | {
            "recordings": sorted(self._recordings()),
            "scene": [] if self._choices is None else self._choices.json(),
            "scene_at": None if self._choices is None else self._choices.at,
            "unread": self.unread,
            "reloads": getattr(self._engine, "reloads", 0),
            "refit": self._fit.brief(),
        }

    def _model(self) -> JsonObject:
        """Return names, units and configured values of the twin, and the estimators."""
        return model_json(self._engine)

    def _episodes(self) -> list[JsonObject]:
        """Return all episodes by their start."""
        return episodes_json(self._engine)

    def _why(self, since: float, until: float) -> JsonObject:
        """Attribute the change of the estimate between two times of the charts, s."""
        model, origin = self._engine.model, self.series.origin() or 0
        begin, end = (origin + round(max(-1e9, min(at, 1e9)) * 1e9) for at in (since, until))
        window = self._engine.window(begin, end)
        if window is None:
            raise EstimatorError("the estimate of this span is not there; choose a later one, or ask again")
        fold = window.fold(policy=self._engine.policy, expected=self._engine.twin.expected)
        return dict(plain(why_json(model, attribution(fold, begin, end), origin)))

    def _annotations(self) -> list[JsonObject]:
        """Return all notes of users by time."""
        return annotations_json(self._engine)

    def _audit(self) -> list[JsonObject]:
        """Return the last commands of users by time, in seconds since 1970."""
        names = ("number", "at", "user", "role", "address", "path", "body", "revision")
        return [{name: getattr(entry, name) for name in names} for entry in self._engine.audit.entries()]

    def _faults(self) -> JsonObject:
        """Return the faults that can be injected into the source."""
        return catalogue_json(self._engine.source, self._engine.model)

    def _command(self, body: object) -> dict[str, str]:
        """Carry out `{"command": NAME, field: value, ...}` (app/engine/commands.py)."""
        command = command_from_json(body, self._engine)
        self._engine.submit(command)
        return {"submitted": type(command).__name__}

    def _scene(self) -> Response | list[JsonObject]:
        """Return the options of the scene."""
        if self._choices is None:
            return PlainTextResponse("Nisus: there is no scene.\n", 404)
        return self._choices.json()

    def _choose(self, key: str, value: str) -> Response | list[JsonObject]:
        """Choose an option of the scene."""
        if self._choices is not None:
            self._choices.choose(key, value)
        return self._scene()

    async def _viewer_file(self, request: Request) -> Response:
        name = request.path_params["name"]
        if name not in FILES:
            return PlainTextResponse("Nisus: there is no such file.\n", 404)
        self._explored.set()
        try:
            folder = await asyncio.wrap_future(self._assets)
        except NisusError as error:
            return PlainTextResponse(f"{error}\n", 503)
        path, media_type = folder / f"{name}.gz", MEDIA_TYPES[Path(name).suffix]
        headers = {"Cache-Control": IMMUTABLE, "Vary": "Accept-Encoding"}
        if "gzip" in request.headers.get("accept-encoding", ""):
            return FileResponse(path, media_type=media_type, headers={**headers, "Content-Encoding": "gzip"})
        content = await in_thread(lambda: gzip.decompress(path.read_bytes()))
        return Response(content, media_type=media_type, headers=headers)

    def _recordings(self) -> dict[str, Path]:
        """Return by name the recordings that this process has written, and the one that it reviews."""
        recorder = self._engine.recorder
        paths = [*(recorder.finished if recorder is not None else ()), *([self._review] if self._review else [])]
        return {path.name: path for path in paths}

    def _list_recordings(self) -> list[JsonObject]:
        """Return names and sizes of the recordings of this process."""
        found = {name: path for name, path in self._recordings().items() if path.is_file()}
        return [{"name": name, "bytes": path.stat().st_size} for name, path in sorted(found.items())]

    def _recording(self, name: str) -> Response:
        """Answer with a recording."""
        path = self._recordings().get(name)
        if path is None or not path.is_file():
            return PlainTextResponse("Nisus: this process has no such recording.\n", 404)
        return FileResponse(path, media_type="application/octet-stream", filename=path.name)

    def _ready(self) -> Response:
        """Answer 200 once the filter is compiled and measurements arrive, else 503 with the reason."""
        status = self._engine.status()
        if status.awaited is not None:
            return PlainTextResponse("the filter is being compiled\n", 503)
        if status.t is None:
            return PlainTextResponse("no measurement has arrived\n", 503)
        return PlainTextResponse("ok\n")

    def _state(self, covariance: bool = False) -> Response:
        """Answer with the present state (see docs/http-api.md)."""
        return _message(state_message(self._engine, covariance=covariance))

    def _openapi(self) -> JsonObject:
        """Return the OpenAPI document of all paths."""
        return openapi([*self.http_server.routes, *self.application.routes])

    def _alerts(self) -> JsonObject:
        """Return open alerts, and the state of outputs and receivers."""
        published = self._engine.published
        return NOT_PUBLISHED if published is None else published.json()

    async def _state_stream(self, request: Request) -> Response:
        """Send the state as server-sent events: after each change, and otherwise each second."""

        async def events() -> AsyncIterator[str]:
            sent, at = None, -np.inf
            while not self._stopping.is_set() and not await request.is_disconnected():
                found = await in_thread(state_message, self._engine)
                new, now = (found.time_ns, found.revision, found.health, found.cause), time.monotonic()
                if new != sent or now - at >= ALIVE_PERIOD_S:
                    sent, at = new, now
                    yield f"event: state\nid: {found.revision}:{found.time_ns}\ndata: {found.model_dump_json()}\n\n"
                await asyncio.sleep(STATUS_PERIOD_S)

        return StreamingResponse(events(), media_type="text/event-stream", headers={"Cache-Control": "no-store"})

    async def _page_stream(self, browser: WebSocket) -> None:
        await PageStream(browser, self._engine, self.series, self._status, self._boot, self._choices).run()

    async def _rerun_stream(self, browser: WebSocket) -> None:
        await browser.accept()
        layout = browser.query_params.get("layout", "1") == "1"
        palette = THEMES.get(browser.query_params.get("theme", ""), EITHER)
        feed = await in_rerun_thread(self._rerun_feed, layout, palette)
        await feed_rerun(browser, feed, self._rerun_status)

    def _rerun_feed(self, layout: bool, palette: Palette) -> RerunFeed:
        """Return a feed of Explore; Rerun takes 50 MB, so it is imported with the first one."""
        from ..explore.feed import RerunFeed

        return RerunFeed(self._engine, layout=layout, palette=palette)

    def _rerun_status(self) -> JsonObject:
        origin = self.series.origin()
        return {
            "status": status_json(self._engine),
            "boot": self._boot,
            "recordings": sorted(self._recordings()),
            "origin": None if origin is None else str(origin),
        }
