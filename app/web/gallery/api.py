"""The gallery over HTTP: twins to start, what runs, and recordings to open, download, delete or receive."""

from __future__ import annotations

import time
from dataclasses import asdict
from pathlib import Path

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from config.extensions import made
from config.loader import find
from estimators.errors import ConfigError, NisusError, quoted

from ...result import JsonObject
from ..http import PAGE, Json, TooLarge, bounded_body, get, one_line, page_file, post, refusal
from ..request_threads import in_thread
from .cards import picture_file, shelf
from .dropped_logs import DroppedLogs
from .gallery import Gallery, StartRequest
from .recordings import DATABASE, RECORDING, Recordings

COMPILING_SHOWN_AFTER_S = 1.0
"""Longer than loading a model from the cache."""

PIECE_BYTES = 4 * 2**20
"""Size of the pieces in which a page sends a dropped file; each has its own timeout."""


class GalleryApi:
    """Serves the gallery and one folder of recordings at the session's port, whatever runs."""

    def __init__(self, gallery: Gallery, recordings: Recordings) -> None:
        """Add the routes to the HTTP server; before the session starts."""
        self._gallery, self._recordings = gallery, recordings
        http_server = gallery.session.http_server
        assert http_server is not None, "a gallery needs a page"
        self._http_server = http_server
        self._logs = DroppedLogs(recordings, gallery.names, gallery.add)
        routes = [
            get("/gallery", self._page),
            Mount("/page", StaticFiles(directory=PAGE)),
            get("/api/session", self.state),
            get("/api/gallery", self._cards),
            post("/api/gallery/start", self._start, status=202),
            post("/api/gallery/stop", self._stop),
            get("/api/gallery/picture", self._picture),
            get("/api/gallery/recordings", self._list),
            post("/api/gallery/recordings/open", self._open, status=202),
            post("/api/gallery/recordings/delete", self._delete),
            Route("/api/gallery/recordings/drop", self._drop, methods=["POST"]),
            get("/recordings/{name}", self._download),
            post("/api/gallery/log", self._logs.state),
            post("/api/gallery/log/curves", self._logs.curves),
            get("/api/gallery/log/draft", self._logs.drafting),
            post("/api/gallery/log/draft", self._logs.draft, status=202),
            post("/api/gallery/log/draft/stop", self._logs.stop_draft),
            *made("gallery"),
        ]
        http_server.add_gallery(routes, Starlette(routes=[get("/", self._page_at_once)]))

    def _page(self) -> Response:
        """Answer with the page of the gallery."""
        return page_file("gallery.html", {"boot": self._http_server.boot}, title="Gallery")

    def _page_at_once(self) -> Response:
        """Answer with the gallery where a twin's page will be."""
        return page_file("gallery.html", {"boot": self._http_server.boot_without_twin}, title="Gallery")

    def state(self) -> JsonObject:
        """Return the running twin, the start under way, and the last start that failed."""
        gallery, running = self._gallery, self._gallery.session.running
        starting, failed, request = gallery.starting, gallery.failed, gallery.running
        begun = gallery.compiling
        compiling = begun is not None and time.monotonic() - begun > COMPILING_SHOWN_AFTER_S
        return {
            "boot": self._http_server.boot,
            "running": running
            and {
                "name": request and request.twin,
                "title": running.engine.twin.name if request is None else request.name,
                "review": running.opening.review is not None,
            },
            "starting": starting
            and {
                "name": starting[0].twin,
                "title": starting[0].name,
                "seconds": round(time.monotonic() - starting[1], 1),
                "doing": "compiling" if compiling else "",
            },
            "failed": failed and {"title": failed[0].name, "text": self._recordings.shortened(one_line(failed[1]))},
        }

    def _cards(self) -> list[JsonObject]:
        """Return a card for each twin."""
        return [asdict(card) for card in shelf(self._gallery.own)]

    def _start(self, twin: str) -> JsonObject:
        """Begin to start a twin."""
        self._gallery.start(StartRequest(twin))
        return self.state()

    def _stop(self) -> JsonObject:
        """Stop the running twin."""
        self._gallery.stop()
        return self.state()

    def _picture(self, twin: str = "") -> Response:
        """Answer with the picture of a twin."""
        if twin not in self._gallery.names():
            return PlainTextResponse(f"Nisus: {quoted(twin)} is no twin of this gallery.\n", 404)
        path = picture_file(find(twin))
        if not path.is_file():
            return PlainTextResponse("Nisus: there is no picture of it.\n", 404)
        return FileResponse(path, media_type="image/svg+xml")

    # Recordings

    def _list(self) -> JsonObject:
        """List the recordings and logs."""
        files = self._recordings.entries(self._is_writing)
        return {"folder": str(self._recordings.folder), "piece": PIECE_BYTES, "files": files}

    def _open(self, name: str, twin: str | None = None) -> JsonObject:
        """Review a recording, or run a twin on a log."""
        path = self._idle(name)
        if path.suffix.lower() == DATABASE:
            raise ConfigError(f"{path.name} holds no frames; open a CAN log, which is read with it")
        if path.suffix.lower() == RECORDING:
            self._gallery.start(StartRequest(recording=path))
        elif twin is not None:
            self._gallery.start(StartRequest(twin, (path,)))
        else:
            raise ConfigError(f"{path.name} is a log; name the twin that is to read it")
        return {"opening": path.name}

    def _delete(self, name: str) -> JsonObject:
        """Delete a recording or log."""
        path = self._idle(name)
        self._recordings.delete(name)
        return {"deleted": path.name}

    def _idle(self, name: str) -> Path:
        path = self._recordings.find(name)
        if self._is_writing(path):
            raise ConfigError(f"{path.name} is being recorded; end the recording first")
        return path

    def _is_writing(self, path: Path) -> bool:
        running = self._gallery.session.running
        writing = None if running is None else running.recorder.writing
        return writing is not None and path.absolute() == writing.absolute()

    async def _drop(self, request: Request) -> Response:
        """Receive a piece of a file: `?name=...&offset=...`, the last one with `&last=1`; the body is its bytes."""
        query = request.query_params
        try:
            if request.headers.get("content-type") != "application/octet-stream":
                raise ConfigError("Content-Type must be application/octet-stream")
            offset = query.get("offset", "")
            if not offset.isascii() or not offset.isdecimal() or len(offset) > 15:
                raise ConfigError("offset must be the number of bytes that were sent before")
            data = await bounded_body(request, PIECE_BYTES)
            last = query.get("last") == "1"
            name = await in_thread(self._recordings.receive, query.get("name"), int(offset), data, last=last)
        except TooLarge as error:
            return refusal(error, 413)
        except NisusError as error:
            return refusal(error)
        return Json({"name": name})

    def _download(self, name: str) -> Response:
        """Answer with a recording or log."""
        try:
            path = self._recordings.find(name)
        except NisusError as error:
            return PlainTextResponse(f"Nisus: {one_line(str(error))}.\n", 404)
        return FileResponse(path, media_type="application/octet-stream", filename=path.name)
