"""A fit over HTTP: begun, looked at, given up, and kept as a version; and advice on the estimator."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import Any

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from estimators.errors import ConfigError, printable

from ..live.history_copy import END_OF_TIME
from ..live.interface import Running
from ..live.revisions import LONGEST_NOTE
from ..live.runs.fitting import Attempt, Fitting
from ..live.tunings.fitted import settings_of
from ..live.tunings.versions import keep, version_text
from ..studies.advice.advising import DONE, Advising
from .answer import answered
from .api import Json, one_line
from .tunings_api import fields_of


class FitApi:
    """The route, and the thread behind it."""

    def __init__(self, engine: Running) -> None:
        self._engine = engine
        self.fitting = Fitting(engine)
        self._advising = Advising(engine)

    def stop(self) -> None:
        """End what is under way."""
        self.fitting.stop()

    def routes(self) -> list[Route]:
        """What is served."""
        return [
            Route("/api/fit", self._fit, methods=["GET", "POST", "DELETE"]),
            Route("/api/fit/keep", self._keep, methods=["POST"]),
            Route("/api/advice", self._advice, methods=["GET", "POST"]),
        ]

    async def _fit(self, request: Request) -> Response:
        if request.method == "POST":
            return await answered(request, self._begin)
        if request.method == "DELETE":
            self.fitting.cancel()
        return Json(await asyncio.to_thread(self._state))

    async def _begin(self, body: Any) -> Response:
        """`{"wanted": ["Q", "R.winding"], "events": 20000}`; without `events` over all that is there."""
        if not isinstance(body, dict) or not body.keys() <= {"wanted", "events"}:
            raise ConfigError('fit: the body must be like {"wanted": ["Q", "R"], "events": 20000}')
        wanted, events = body.get("wanted"), body.get("events")
        if not isinstance(wanted, list) or not all(isinstance(key, str) for key in wanted):
            raise ConfigError('fit: wanted must be a list of keys, like ["Q", "R.winding"]')
        if events is not None and (not isinstance(events, int) or isinstance(events, bool) or events < 1):
            raise ConfigError("fit: events must be a positive whole number, or be left out for all")
        await asyncio.to_thread(self.fitting.begin, list(dict.fromkeys(wanted)), events)
        return Json(await asyncio.to_thread(self._state), 202)

    async def _keep(self, request: Request) -> Response:
        """Keep what the last fit found as a tuning version, with what it was worth on the blocks held out."""

        async def work(body: Any) -> Response:
            return Json({"name": await asyncio.to_thread(self._kept, *fields_of(body, name=str, note=str))})

        return await answered(request, work)

    async def _advice(self, request: Request) -> Response:
        """Which estimator the log speaks for; begun by a post."""

        async def begin(body: Any) -> Response:
            fields_of(body)
            self._advising.begin()
            return Json(self._advised(), 202)

        return await answered(request, begin) if request.method == "POST" else Json(self._advised())

    def _advised(self) -> dict[str, Any]:
        found = self._advising
        current = found.revision == self._engine.revisions.runs[-1].number
        told = {"state": found.state, "revision": found.revision, "current": current, "reason": one_line(found.reason)}
        return told | ({"advice": found.told} if found.state == DONE else {})

    def _kept(self, name: str, note: str) -> str:
        twin, attempt = self._engine.twin, self.fitting.latest
        if attempt is None or attempt.fitted is None:
            raise ConfigError("fit: there is no result to keep; fit first")
        if len(note) > LONGEST_NOTE:
            raise ConfigError(f"note: it has {len(note)} characters; it may have {LONGEST_NOTE}")
        fitted_on = [f"{attempt.events} events over {attempt.seconds:.4g} s, from run {attempt.revision}"]
        given = settings_of(attempt.fitted, fitted_on, printable(note))
        given = replace(given, model_version=self._engine.status().model_version)
        keep(twin, name, version_text(twin, given))
        return name

    def _state(self) -> dict[str, Any]:
        """`available` events there are to fit to; `current` is whether what runs is what it was fitted from."""
        engine, attempt = self._engine, self.fitting.latest
        there = {"available": engine.index_at(END_OF_TIME) - engine.rows(0, 0).first}
        if attempt is None:
            return {"state": "none"} | there
        return attempt_json(attempt) | there | {"current": engine.folded_with()[0] is attempt.tuning}


def attempt_json(attempt: Attempt) -> dict[str, Any]:
    """A fit as JSON; `values` are those by which the tuning would be turned, by key."""
    told: dict[str, Any] = {
        "number": attempt.number,
        "state": attempt.state,
        "wanted": list(attempt.wanted),
        "estimator": attempt.estimator,
        "revision": attempt.revision,
        "events": attempt.events,
        "seconds": attempt.seconds,
        "folds": attempt.folds,
        "elapsed": attempt.elapsed,
        "reason": one_line(attempt.reason),
    }
    if attempt.fitted is None:
        return told
    from ..live.runs.runs_json import fit_json

    values = {line.key: line.after for line in attempt.fitted.lines if not line.alone}
    return told | {"result": fit_json(attempt.fitted), "values": values}
