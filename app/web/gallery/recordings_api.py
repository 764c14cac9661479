"""The part of the page's API that deals with recordings: list, open, download, delete, drop."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import BaseRoute, Route

from estimators.errors import ConfigError, NisusError

from ..answer import answered
from ..api import Json, one_line
from ..bounds import TooLarge, bounded_body
from .gallery import Gallery, Wanted
from .recordings import RECORDING, Recordings

PIECE = 4 * 2**20
"""Bytes of a dropped file that a page sends at once: each piece has its own time to arrive."""


class RecordingsApi:
    """Serves one folder of recordings, whatever runs."""

    def __init__(self, gallery: Gallery, recordings: Recordings) -> None:
        self._gallery, self._recordings = gallery, recordings

    def routes(self) -> list[BaseRoute]:
        """Its addresses."""
        return [
            Route("/api/gallery/recordings", self._list),
            Route("/api/gallery/recordings/open", self._open, methods=["POST"]),
            Route("/api/gallery/recordings/delete", self._delete, methods=["POST"]),
            Route("/api/gallery/recordings/drop", self._drop, methods=["POST"]),
            Route("/recordings/{name}", self._download),
        ]

    def _busy(self, path: Path) -> bool:
        running = self._gallery.session.running
        writing = None if running is None else running.recorder.writing
        return writing is not None and path.absolute() == writing.absolute()

    async def _list(self, request: Request) -> Response:
        found = await asyncio.to_thread(self._recordings.entries, self._busy)
        folder = str(self._recordings.folder)
        return Json({"folder": folder, "piece": PIECE, "files": [entry.json() for entry in found]})

    async def _open(self, request: Request) -> Response:
        """Review a recording, or run a twin on a log: `{"name": …}`, of a log with `"twin"`."""

        async def open_it(body: Any) -> Response:
            name, twin = (body.get("name"), body.get("twin")) if isinstance(body, dict) else (None, None)
            path = self._recordings.find(name)
            if self._busy(path):
                raise ConfigError(f"{path.name} is being recorded; end the recording, then open it")
            if path.suffix.lower() == RECORDING:
                self._gallery.start(Wanted(recording=path))
            elif isinstance(twin, str):
                self._gallery.start(Wanted(twin, (path,)))
            else:
                raise ConfigError(f"{path.name} is a log; name the twin that is to read it")
            return Json({"opening": path.name}, 202)

        return await answered(request, open_it)

    async def _delete(self, request: Request) -> Response:
        async def delete(body: Any) -> Response:
            name = body.get("name") if isinstance(body, dict) else None
            path = self._recordings.find(name)
            if self._busy(path):
                raise ConfigError(f"{path.name} is being recorded; end the recording first")
            await asyncio.to_thread(self._recordings.delete, name)
            return Json({"deleted": path.name})

        return await answered(request, delete)

    async def _drop(self, request: Request) -> Response:
        """Take a piece of a file: `?name=…&offset=…`, of the last one with `&last=1`; the body is its bytes."""
        asked = request.query_params
        try:
            if request.headers.get("content-type") != "application/octet-stream":
                raise ConfigError("Content-Type must be application/octet-stream")
            text = asked.get("offset", "")
            if not text.isascii() or not text.isdecimal() or len(text) > 15:
                raise ConfigError("offset must be the number of bytes that were sent before")
            data = await bounded_body(request, PIECE)
            name = await asyncio.to_thread(
                self._recordings.receive, asked.get("name"), int(text), data, last=asked.get("last") == "1"
            )
        except TooLarge as error:
            return Json({"error": one_line(str(error))}, 413)
        except NisusError as error:
            return Json({"error": one_line(str(error))}, 400)
        return Json({"name": name})

    async def _download(self, request: Request) -> Response:
        try:
            path = self._recordings.find(request.path_params["name"])
        except NisusError as error:
            return PlainTextResponse(f"Nisus: {one_line(str(error))}.\n", 404)
        return FileResponse(path, media_type="application/octet-stream", filename=path.name)
