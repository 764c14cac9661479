"""Page server of a running twin: the page, its API, its streams, recordings, and Viser behind it."""

from __future__ import annotations

import asyncio
import gzip
import sys
import threading
import uuid
from concurrent.futures import Future
from pathlib import Path
from typing import TYPE_CHECKING, Any

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket

from estimators.errors import ConfigError, NisusError

from ..live.running_fold import Running
from ..live.runs.refits import Refits
from ..present.drawing.colors import EITHER, THEMES
from ..present.export.alarm_guide import alarms_text, as_html
from ..present.series.series import Series
from ..studies.analysis.diagnosis import Diagnosis
from ..studies.analysis.forecast import Forecasts, question_from_json
from ..views.rerun.feed import RerunFeed
from .commands_json import command_from_json
from .door import Door
from .fit_api import FitApi
from .http import PAGE, OneAtATime, get, page_file, post
from .runs_api import RunsApi
from .streams import PageStream, feed_rerun
from .twin_json import episodes_json, faults_json, model_json, status_json
from .viewer_assets import FILES, viewer_assets, viewer_version
from .viser_proxy import ViserProxy

if TYPE_CHECKING:
    from ..views.viser.stage import Choices

AWAITED_PERIOD_S = 0.5
"""Between two looks at whether the first filter is compiled."""

CHART_FILES = sorted(path.name for path in (PAGE / "charts").glob("*.js"))
"""Kinds of charts, one a file."""

FOR_EVER = "public, max-age=31536000, immutable"
MEDIA_TYPES = {".js": "text/javascript", ".wasm": "application/wasm"}


class PageServer:
    """Serves one engine to any number of browsers, behind a door that may outlive it."""

    def __init__(
        self,
        engine: Running,
        *,
        port: int | Door,
        viser_port: int | None,
        secret: str,
        review: Path | None = None,
        choices: Choices | None = None,
        refits: Refits | None = None,
    ) -> None:
        """Take the port, if it is not open yet.

        Args:
            engine: What to show.
            port: On 127.0.0.1; 0 takes a free one. Or an open door, which shows this once it is started.
            viser_port: Where the private Viser server listens; None if there is none.
            secret: What Viser asks for.
            review: The recording that is reviewed, offered beside those that this process writes.
            choices: Options of Viser's scene; None if there is no scene.
            refits: Fits of the last window; None for none.

        Raises:
            ConfigError: If the port cannot be taken.
        """
        self._engine = engine
        self._review = review
        self._choices = choices
        self.series = Series(engine)
        self._runs = RunsApi(engine, self.series)
        self.refits = refits or Refits(engine)
        self._fit = FitApi(engine, self.refits)
        self._forecasts, self._diagnosis = Forecasts(engine), Diagnosis(engine)
        self._boot = uuid.uuid4().hex
        self.unread: str | None = None
        """Why the twin's files, as saved last, could not be read; None if they run."""
        self._own_door = not isinstance(port, Door)
        self.door = port if isinstance(port, Door) else Door(port)
        self.port, self.entered = self.door.port, self.door.entered
        self._assets: Future[Path] = Future()
        self._explored, self._stopping = threading.Event(), threading.Event()
        self._viser = ViserProxy(viser_port, secret) if viser_port is not None else None
        self.application = Starlette(routes=self._routes())

    @property
    def url(self) -> str:
        """Address of the page, with its token."""
        return self.door.url

    def start(self) -> threading.Event:
        """Serve; the Rerun viewer's files are prepared later, if this machine does not have them yet."""
        threading.Thread(target=self._prepare, name="viewer assets", daemon=True).start()
        over = self.door.show(self.application, self._boot)
        if self._own_door:
            self.door.start()
        return over

    def stop(self) -> None:
        """Stop all work, close all connections, and the port if it is this twin's own."""
        self._stopping.set()
        if self._own_door:
            self.door.stop()

    def _prepare(self) -> None:
        # The first filter comes first, unless somebody looks at Explore already: both take all processors.
        while self._engine.status().awaited is not None and not self._explored.is_set():
            if self._stopping.wait(AWAITED_PERIOD_S):
                return
        try:
            self._assets.set_result(viewer_assets(lambda line: print(line, file=sys.stderr, flush=True)))
        except NisusError as error:
            self._assets.set_exception(error)

    def _routes(self) -> list[Any]:
        engine = self._engine
        forecasting, diagnosing = OneAtATime("forecast"), OneAtATime("diagnosis")
        routes: list[Any] = [
            Route("/", get(lambda: self._page("index.html"))),
            Route("/explore", get(lambda: self._page("explore.html"))),
            Route("/alarms", get(self._alarms)),
            Route("/api/status", get(self._state)),
            Route("/api/model", get(lambda: model_json(engine))),
            Route("/api/episodes", get(lambda: episodes_json(engine))),
            Route("/api/faults", get(lambda: faults_json(engine))),
            *self._runs.routes(),
            *self._fit.routes(),
            Route("/api/command", post(self._command, status=202), methods=["POST"]),
            Route("/api/forecast", get(self._forecasts.may, refused=409)),
            Route("/api/forecast", post(self._forecast, run=forecasting), methods=["POST"]),
            Route("/api/diagnose", get(self._diagnosis.look, refused=503, run=diagnosing)),
            Route("/api/scene", get(self._scene)),
            Route("/api/scene", post(self._choose), methods=["POST"]),
            Route("/api/recordings", get(self._list_recordings)),
            Route("/rec/{name}", get(self._recording)),
            Route(f"/viewer/{viewer_version()}/{{name}}", self._viewer_file),
            WebSocketRoute("/api/stream", self._page_stream),
            WebSocketRoute("/rerun/stream", self._rerun_stream),
            Mount("/page", StaticFiles(directory=PAGE)),
        ]
        if self._viser is not None:
            routes += [
                WebSocketRoute("/viser/{path:path}", self._viser.websocket),
                WebSocketRoute("/viser", self._viser.websocket),
                Route("/viser/{path:path}", self._viser.http),
            ]
        return routes

    def _page(self, name: str) -> Response:
        settings = {"viewer": f"/viewer/{viewer_version()}", "boot": self._boot, "viser": self._viser is not None}
        settings["charts"] = CHART_FILES
        return page_file(name, settings | {"gallery": self.door.furnished, "stage_pass": self.door.stage_pass})

    def _alarms(self) -> Response:
        """Answer with docs/alarms.md, to which episodes refer."""
        try:
            text = as_html(alarms_text())
        except ConfigError as error:
            return PlainTextResponse(f"Nisus: {error}\n", 404)
        return Response((PAGE / "alarms.html").read_text().replace("{{text}}", text), media_type="text/html")

    def _state(self) -> dict[str, Any]:
        scene = [] if self._choices is None else self._choices.json()
        status = {**status_json(self._engine), "recordings": sorted(self._recordings()), "scene": scene}
        reloads = getattr(self._engine, "reloads", 0)
        return {**status, "unread": self.unread, "reloads": reloads, "refit": self._fit.brief()}

    def _command(self, body: Any) -> Any:
        command = command_from_json(body, self._engine)
        self._engine.submit(command)
        return {"submitted": type(command).__name__}

    def _forecast(self, body: Any) -> Any:
        return self._forecasts.ask(question_from_json(body, self._engine.model))

    def _scene(self) -> Any:
        """Return the options of the scene."""
        if self._choices is None:
            return PlainTextResponse("Nisus: there is no scene.\n", 404)
        return self._choices.json()

    def _choose(self, key: str, value: str) -> Any:
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
        path = folder / f"{name}.gz"
        headers = {"Cache-Control": FOR_EVER, "Vary": "Accept-Encoding"}
        media_type = MEDIA_TYPES[Path(name).suffix]
        if "gzip" in request.headers.get("accept-encoding", ""):
            return FileResponse(path, media_type=media_type, headers={**headers, "Content-Encoding": "gzip"})
        content = await run_in_threadpool(lambda: gzip.decompress(path.read_bytes()))
        return Response(content, media_type=media_type, headers=headers)

    def _recordings(self) -> dict[str, Path]:
        """Return by name the recordings that this process has written, and the one that it reviews."""
        recorder = self._engine.recorder
        paths = [*(recorder.finished if recorder is not None else ()), *([self._review] if self._review else [])]
        return {path.name: path for path in paths}

    def _list_recordings(self) -> Any:
        found = {name: path for name, path in self._recordings().items() if path.is_file()}
        return [{"name": name, "bytes": path.stat().st_size} for name, path in sorted(found.items())]

    def _recording(self, name: str) -> Response:
        path = self._recordings().get(name)
        if path is None or not path.is_file():
            return PlainTextResponse("Nisus: this process has no such recording.\n", 404)
        return FileResponse(path, media_type="application/octet-stream", filename=path.name)

    async def _page_stream(self, browser: WebSocket) -> None:
        await PageStream(browser, self._engine, self.series, self._state, self._boot).run()

    async def _rerun_stream(self, browser: WebSocket) -> None:
        await browser.accept()
        layout = browser.query_params.get("layout", "1") == "1"
        palette = THEMES.get(browser.query_params.get("theme", ""), EITHER)
        feed = await asyncio.to_thread(RerunFeed, self._engine, layout=layout, palette=palette)
        await feed_rerun(browser, feed, self._rerun_status)

    def _rerun_status(self) -> dict[str, Any]:
        origin = self.series.origin()
        status = {"status": status_json(self._engine), "boot": self._boot, "recordings": sorted(self._recordings())}
        return status | {"origin": None if origin is None else str(origin)}
