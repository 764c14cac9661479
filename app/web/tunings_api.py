"""Tuning versions over HTTP: listed, a run kept as one, and one loaded."""

from __future__ import annotations

import asyncio
from typing import Any

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from config.tunings import NAME
from estimators.errors import ConfigError, printable

from ..live.changes import difference
from ..live.interface import Running
from ..live.revisions import LONGEST_NOTE
from ..live.runs.scores import RunScores
from ..live.tunings.versions import Settings, figures, keep, listing, load_into, version_text
from ..studies.guard.last import last
from ..twin.twin import with_version
from .answer import answered
from .api import Json, one_line


class TuningsApi:
    """The routes."""

    def __init__(self, engine: Running, scores: RunScores) -> None:
        self._engine, self._scores = engine, scores

    def routes(self) -> list[Route]:
        """What is served."""
        return [
            Route("/api/tunings", self._list),
            Route("/api/tunings", self._keep, methods=["POST"]),
            Route("/api/tunings/load", self._load, methods=["POST"]),
            Route("/api/tunings/{name}/against", self._against),
        ]

    async def _list(self, request: Request) -> Response:
        twin = self._engine.twin
        versions = await asyncio.to_thread(listing, twin)
        guarded = await asyncio.to_thread(last, twin.path)
        return Json({"running": self._engine.status().tuning.name, "versions": versions, "guard": guarded})

    async def _keep(self, request: Request) -> Response:
        """Keep a run as a version, with what it was worth."""

        async def work(body: Any) -> Response:
            return Json({"name": await asyncio.to_thread(self._kept, *fields_of(body, run=int, name=str, note=str))})

        return await answered(request, work)

    def _kept(self, number: int, name: str, note: str) -> str:
        if len(note) > LONGEST_NOTE:
            raise ConfigError(f"note: it has {len(note)} characters; it may have {LONGEST_NOTE}")
        run = self._engine.revisions.find(number)
        known = next((known for other, known in self._scores.all() if other.number == number), None)
        given = Settings(
            run.estimator,
            run.tuning,
            note=printable(note),
            scores={} if known is None else figures(known.score),
            model_version=self._engine.status().model_version,
        )
        twin = self._engine.twin
        keep(twin, name, version_text(twin, given))
        return name

    async def _against(self, request: Request) -> Response:
        """In which entries a version differs from what runs."""
        try:
            return Json(await asyncio.to_thread(self._differing, request.path_params["name"]))
        except ConfigError as error:
            return Json({"error": one_line(str(error))}, 404)

    def _differing(self, name: str) -> list[dict[str, Any]]:
        tuning, estimator = self._engine.folded_with()
        twin = with_version(self._engine.twin, _listed(name))
        differ = difference(twin.estimator, twin.tuning, estimator, tuning)
        return [{"key": change.key, "values": [change.before, change.after]} for change in differ]

    async def _load(self, request: Request) -> Response:
        """Go on with a version; the history is folded again with it."""

        async def work(body: Any) -> Response:
            return Json({"name": await asyncio.to_thread(self._loaded, *fields_of(body, name=str))})

        return await answered(request, work)

    def _loaded(self, name: str) -> str:
        load_into(self._engine, _listed(name))
        return name


def _listed(name: str) -> str:
    """A name, no path: a page chooses among what is beside the twin."""
    if not NAME.fullmatch(name) or name.endswith((".yaml", ".yml")):
        raise ConfigError(f"{name}: no version is read from there; name one that /api/tunings lists")
    return name


def fields_of(body: Any, **kinds: type) -> list[Any]:
    """The fields of a request, in their order.

    Raises:
        ConfigError: If one is missing, of another kind, or unknown.
    """
    if not isinstance(body, dict) or set(body) != set(kinds):
        raise ConfigError(f"the body must be an object of {', '.join(kinds)}")
    for name, kind in kinds.items():
        if type(body[name]) is not kind:
            raise ConfigError(f"{name}: it must be {'a text' if kind is str else 'a whole number'}")
    return [body[name] for name in kinds]
