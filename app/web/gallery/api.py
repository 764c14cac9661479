"""The gallery's part of the page's API: what there is, what runs, start and stop."""

from __future__ import annotations

import asyncio
import time
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from config.loader import find
from estimators.errors import ConfigError, quoted

from ..answer import answered
from ..api import Json, one_line
from ..page_file import PAGE, page_file
from .gallery import Gallery, Wanted
from .pictures import picture_file
from .recordings import Recordings
from .recordings_api import RecordingsApi
from .shelf import shelf

PATIENCE = 1.0
"""Seconds after which it is said that a model is compiled; loading it from the cache takes less."""


class GalleryApi:
    """Serves the gallery at the session's door, whatever else is shown there."""

    def __init__(self, gallery: Gallery, recordings: Recordings) -> None:
        """Furnish the door; before the session starts."""
        self._gallery = gallery
        door = gallery.session.door
        assert door is not None, "a gallery needs a page"
        self._door = door
        routes = [
            Route("/gallery", self._page),
            Mount("/page", StaticFiles(directory=PAGE)),
            Route("/api/session", self._state),
            Route("/api/gallery", self._cards),
            Route("/api/gallery/start", self._start, methods=["POST"]),
            Route("/api/gallery/stop", self._stop, methods=["POST"]),
            Route("/api/gallery/picture", self._picture),
            *RecordingsApi(gallery, recordings).routes(),
        ]
        door.furnish(routes, Starlette(routes=[Route("/", self._page)]))

    async def _page(self, request: Request) -> Response:
        return page_file("gallery.html", {"boot": self._door.boot})

    async def _state(self, request: Request) -> Response:
        return Json(self.state())

    def state(self) -> dict[str, Any]:
        """What runs, what is being started, and what could not be."""
        gallery, running = self._gallery, self._gallery.session.running
        starting, failed, wanted = gallery.starting, gallery.failed, gallery.running
        begun = gallery.compiling
        compiling = begun is not None and time.monotonic() - begun > PATIENCE
        return {
            "boot": self._door.boot,
            "running": None
            if running is None
            else {
                "name": None if wanted is None else wanted.twin,
                "title": running.engine.twin.name if wanted is None else wanted.name,
                "review": running.opening.review is not None,
            },
            "starting": None
            if starting is None
            else {
                "name": starting[0].twin,
                "title": starting[0].name,
                "seconds": round(time.monotonic() - starting[1], 1),
                "doing": "compiling" if compiling else "",
            },
            "failed": None if failed is None else {"title": failed.name, "text": one_line(failed.text)},
        }

    async def _cards(self, request: Request) -> Response:
        cards = await asyncio.to_thread(shelf, self._gallery.own)
        return Json([card.json() for card in cards])

    async def _start(self, request: Request) -> Response:
        async def start(body: Any) -> Response:
            name = body.get("twin") if isinstance(body, dict) else None
            if not isinstance(name, str):
                raise ConfigError('the body must be like {"twin": "motor_can"}')
            self._gallery.start(Wanted(name))
            return Json(self.state(), 202)

        return await answered(request, start)

    async def _stop(self, request: Request) -> Response:
        async def stop(body: Any) -> Response:
            await asyncio.to_thread(self._gallery.stop)
            return Json(self.state())

        return await answered(request, stop)

    async def _picture(self, request: Request) -> Response:
        name = request.query_params.get("twin", "")
        if name not in self._gallery.names():
            return PlainTextResponse(f"Nisus: {quoted(name)} is no twin of this gallery.\n", 404)
        path: Path = picture_file(find(name))
        if not path.is_file():
            return PlainTextResponse("Nisus: there is no picture of it.\n", 404)
        return FileResponse(path, media_type="image/svg+xml")
