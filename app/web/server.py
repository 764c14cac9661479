"""What is served of a running twin: the page, its API, its streams, recordings, and Viser behind it."""

from __future__ import annotations

import asyncio
import contextlib
import gzip
import json
import sys
import threading
import time
import uuid
from collections.abc import AsyncIterator
from concurrent.futures import Future
from pathlib import Path
from typing import TYPE_CHECKING, Any

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket

from estimators.errors import ConfigError, NisusError

from ..live.interface import Running
from ..live.runs.refits import Refits
from ..present.drawing.colors import EITHER, THEMES
from ..present.export import markdown
from ..present.export.alarms import alarms_text
from ..present.series.series import Series
from ..studies.analysis.diagnosis import Diagnosis
from ..studies.analysis.forecast import Forecasts, question_from_json
from ..views.rerun.feed import RerunFeed
from .answer import answered
from .api import Json, command_from_json, episodes_json, faults_json, one_line, status_json
from .bounds import BODY
from .door import Door
from .export_api import ExportApi
from .fit_api import FitApi
from .model_json import model_json
from .one_at_a_time import OneAtATime
from .page_file import PAGE, page_file
from .page_stream import PageStream
from .refit_api import RefitApi
from .runs_api import RunsApi
from .tunings_api import TuningsApi
from .viewer_assets import FILES, viewer_assets, viewer_version
from .viser_proxy import ViserProxy

if TYPE_CHECKING:
    from ..views.viser.stage import Choices

PERIOD = 0.2
"""Seconds between two frames that one Rerun viewer is fed, at least."""

STATUS_PERIOD = 0.5
"""Seconds between two status messages."""

FOR_EVER = "public, max-age=31536000, immutable"
KINDS = {".js": "text/javascript", ".wasm": "application/wasm"}


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
            port: On 127.0.0.1; 0 takes a free one. Or the door that is there: it shows this once it is started.
            viser_port: Where the private Viser server listens; None if there is none.
            secret: What Viser asks for.
            review: The recording that is reviewed, offered beside those that this process writes.
            choices: What may be chosen about Viser's scene; None if there is none.
            refits: What is fitted beside it now and then; None for nothing, ever.

        Raises:
            ConfigError: If the port cannot be had.
        """
        self._engine = engine
        self._review = review
        self._choices = choices
        self._series = Series(engine)
        self._runs = RunsApi(engine)
        self._fit, self._refit = FitApi(engine), RefitApi(refits or Refits(engine))
        self._exports = ExportApi(engine, self._series, self._runs.scores)
        self._forecasts, self._diagnosis = Forecasts(engine), Diagnosis(engine)
        self._forecasting, self._diagnosing = OneAtATime("forecast"), OneAtATime("diagnosis")
        self._boot = uuid.uuid4().hex
        self.unread: str | None = None
        """What is wrong with the twin's files as they were saved last, if they are not what runs."""
        self._own_door = not isinstance(port, Door)
        self.door = port if isinstance(port, Door) else Door(port)
        self.port, self.entered = self.door.port, self.door.entered
        self._assets: Future[Path] = Future()
        self._explored, self._stopping = threading.Event(), threading.Event()
        self._viser = ViserProxy(viser_port, secret) if viser_port is not None else None
        self.application = self._application()

    @property
    def url(self) -> str:
        """Address of the page, with the token that it asks for."""
        return self.door.url

    def start(self) -> threading.Event:
        """Serve; the Rerun viewer's files are prepared later, if this machine has not got them yet."""
        threading.Thread(target=self._prepare, name="viewer assets", daemon=True).start()
        self._runs.start()
        over = self.door.show(self.application, self._boot)
        if self._own_door:
            self.door.start()
        return over

    def stop(self) -> None:
        """Compute nothing any more; close all connections and the port, if it is this twin's own."""
        self._stopping.set()
        self._runs.stop()
        self._fit.stop()
        if self._own_door:
            self.door.stop()

    def _prepare(self) -> None:
        # What every page waits for comes first, unless somebody looks at Explore already: both take all processors.
        while self._engine.status().awaited is not None and not self._explored.is_set():
            if self._stopping.wait(STATUS_PERIOD):
                return
        try:
            self._assets.set_result(viewer_assets(lambda line: print(line, file=sys.stderr, flush=True)))
        except NisusError as error:
            self._assets.set_exception(error)

    def _application(self) -> Starlette:
        routes: list[Any] = [
            Route("/", self._page),
            Route("/explore", self._page),
            Route("/alarms", self._alarms),
            Route("/api/status", self._status),
            Route("/api/model", self._model),
            Route("/api/episodes", self._episodes),
            *self._runs.routes(),
            *self._fit.routes(),
            *self._refit.routes(),
            *TuningsApi(self._engine, self._runs.scores).routes(),
            *self._exports.routes(),
            Route("/api/recordings", self._list_recordings),
            Route("/api/faults", self._faults),
            Route("/api/command", self._command, methods=["POST"]),
            Route("/api/forecast", self._forecast, methods=["GET", "POST"]),
            Route("/api/diagnose", self._diagnose),
            Route("/api/scene", self._scene, methods=["GET", "POST"]),
            Route(f"/viewer/{viewer_version()}/{{name}}", self._viewer_file),
            Route("/rec/{name}", self._recording),
            WebSocketRoute("/api/stream", self._page_stream),
            WebSocketRoute("/rerun/stream", self._stream),
            Mount("/page", StaticFiles(directory=PAGE)),
        ]
        if self._viser is not None:
            routes += [
                WebSocketRoute("/viser/{path:path}", self._viser.websocket),
                WebSocketRoute("/viser", self._viser.websocket),
                Route("/viser/{path:path}", self._viser.http),
            ]
        return Starlette(routes=routes)

    async def _page(self, request: Request) -> Response:
        name = "explore.html" if request.url.path == "/explore" else "index.html"
        settings = {"viewer": f"/viewer/{viewer_version()}", "boot": self._boot, "viser": self._viser is not None}
        settings |= {"gallery": self.door.furnished, "stage_pass": self.door.stage_pass}
        return page_file(name, settings)

    async def _alarms(self, request: Request) -> Response:
        """docs/alarms.md, to which episodes refer."""
        try:
            text = markdown.as_html(alarms_text())
        except ConfigError as error:
            return PlainTextResponse(f"Nisus: {error}\n", 404)
        return Response((PAGE / "alarms.html").read_text().replace("{{text}}", text), media_type="text/html")

    async def _status(self, request: Request) -> Response:
        return Json(await asyncio.to_thread(self._state))

    def _state(self) -> dict[str, Any]:
        scene = [] if self._choices is None else self._choices.json()
        status = {**status_json(self._engine), "recordings": sorted(self._recordings()), "scene": scene}
        reloads = getattr(self._engine, "reloads", 0)
        return {**status, "unread": self.unread, "reloads": reloads, "refit": self._refit.brief()}

    async def _model(self, request: Request) -> Response:
        return Json(await asyncio.to_thread(model_json, self._engine))

    async def _page_stream(self, browser: WebSocket) -> None:
        await PageStream(browser, self._engine, self._series, self._state, self._boot).run()

    async def _episodes(self, request: Request) -> Response:
        return Json(episodes_json(self._engine))

    async def _list_recordings(self, request: Request) -> Response:
        found = {name: path for name, path in self._recordings().items() if path.is_file()}
        return Json([{"name": name, "bytes": path.stat().st_size} for name, path in sorted(found.items())])

    async def _faults(self, request: Request) -> Response:
        return Json(faults_json(self._engine))

    async def _command(self, request: Request) -> Response:
        async def submit(body: Any) -> Response:
            command = command_from_json(body, self._engine)
            self._engine.submit(command)
            return Json({"submitted": type(command).__name__}, 202)

        return await answered(request, submit)

    async def _forecast(self, request: Request) -> Response:
        if request.method == "GET":
            try:
                return Json(await asyncio.to_thread(self._forecasts.may))
            except NisusError as error:
                return Json({"error": one_line(str(error))}, 409)

        async def ask(body: Any) -> Response:
            question = question_from_json(body, self._engine.model)
            return Json(await self._forecasting.do(lambda: self._forecasts.ask(question)))

        return await answered(request, ask)

    async def _diagnose(self, request: Request) -> Response:
        try:
            return Json(await self._diagnosing.do(self._diagnosis.look))
        except NisusError as error:
            return Json({"error": one_line(str(error))}, 503)

    async def _scene(self, request: Request) -> Response:
        """What may be chosen about the scene; or choose, with `{"key": …, "value": …}`."""
        choices = self._choices
        if choices is None:
            return PlainTextResponse("Nisus: there is no scene.\n", 404)

        async def choose(body: Any) -> Response:
            if not isinstance(body, dict):
                raise ConfigError(f"scene: {body!r} is no object")
            choices.choose(str(body.get("key")), str(body.get("value")))
            return Json(choices.json())

        return Json(choices.json()) if request.method != "POST" else await answered(request, choose)

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
        kind = KINDS[Path(name).suffix]
        if "gzip" in request.headers.get("accept-encoding", ""):
            return FileResponse(path, media_type=kind, headers={**headers, "Content-Encoding": "gzip"})
        content = await asyncio.to_thread(lambda: gzip.decompress(path.read_bytes()))
        return Response(content, media_type=kind, headers=headers)

    def _recordings(self) -> dict[str, Path]:
        """What may be fetched: recordings that this process wrote, and the one it reviews."""
        recorder = self._engine.recorder
        paths = [
            *(recorder.finished if recorder is not None else ()),
            *([self._review] if self._review is not None else []),
        ]
        return {path.name: path for path in paths}

    async def _recording(self, request: Request) -> Response:
        path = self._recordings().get(request.path_params["name"])
        if path is None or not path.is_file():
            return PlainTextResponse("Nisus: this process has no such recording.\n", 404)
        return FileResponse(path, media_type="application/octet-stream", filename=path.name)

    async def _stream(self, browser: WebSocket) -> None:
        """Feed one Rerun viewer: each frame when it has drawn the one before."""
        await browser.accept()
        layout = browser.query_params.get("layout", "1") == "1"
        palette = THEMES.get(browser.query_params.get("theme", ""), EITHER)
        feed = await asyncio.to_thread(RerunFeed, self._engine, layout=layout, palette=palette)
        drawn = asyncio.Event()
        drawn.set()
        listener = asyncio.create_task(_listen_to(browser, drawn))
        feeder = asyncio.create_task(self._feed(browser, feed, drawn))
        try:
            await asyncio.wait([listener, feeder], return_when=asyncio.FIRST_COMPLETED)
        finally:
            # Cancelled first, then awaited: the feed is closed only when no thread is inside it.
            for task in (listener, feeder):
                task.cancel()
            await asyncio.gather(listener, feeder, return_exceptions=True)
            await asyncio.to_thread(feed.close)
            with contextlib.suppress(RuntimeError):
                await browser.close()

    async def _feed(self, browser: WebSocket, feed: RerunFeed, drawn: asyncio.Event) -> None:
        told = -STATUS_PERIOD
        while True:
            begun = time.monotonic()
            if begun - told >= STATUS_PERIOD:
                told = begun
                status, origin = await asyncio.to_thread(lambda: (status_json(self._engine), self._series.origin()))
                news = {"status": status, "boot": self._boot, "origin": None if origin is None else str(origin)}
                await browser.send_text(json.dumps({**news, "recordings": sorted(self._recordings())}))
            if drawn.is_set():
                async for message in _given(feed):
                    if isinstance(message, str):
                        await browser.send_text(message)
                    else:
                        drawn.clear()
                        await browser.send_bytes(message)
            with contextlib.suppress(TimeoutError):
                # Until the frame is drawn, or the status is due.
                await asyncio.wait_for(drawn.wait(), STATUS_PERIOD)
            await asyncio.sleep(max(0.0, PERIOD - (time.monotonic() - begun)))


async def _given(feed: RerunFeed) -> AsyncIterator[str | bytes]:
    """What the feed gives next, made in a thread: a long history takes a while."""
    task = asyncio.ensure_future(asyncio.to_thread(feed.next))
    try:
        messages = await asyncio.shield(task)
    except asyncio.CancelledError:
        await task
        raise
    for message in messages:
        yield message


async def _listen_to(browser: WebSocket, drawn: asyncio.Event) -> None:
    """A word from the browser says that it has drawn what it got; whoever says anything longer is not the page."""
    while (word := (await browser.receive()).get("text")) is not None and len(word) <= BODY:
        drawn.set()
