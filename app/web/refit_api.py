"""Dual estimation over HTTP: what was fitted on the last windows, what is proposed, adopted or dismissed."""

from __future__ import annotations

import asyncio
from typing import Any

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from ..live.runs.refits import FITTING, Refit, Refits
from .answer import answered
from .api import Json, one_line
from .tunings_api import fields_of


class RefitApi:
    """The routes."""

    def __init__(self, refits: Refits) -> None:
        self._refits = refits

    def routes(self) -> list[Route]:
        """What is served."""
        return [
            Route("/api/refit", self._look, methods=["GET", "POST"]),
            Route("/api/refit/accept", self._accept, methods=["POST"]),
            Route("/api/refit/dismiss", self._dismiss, methods=["POST"]),
        ]

    def brief(self) -> dict[str, Any] | None:
        """For the status: the last fit, how it stands, and which is proposed; None where the YAML names nothing."""
        if self._refits.section is None:
            return None
        known, offered = self._refits.known, self._refits.open
        last = known[-1] if known else None
        return {
            "last": None if last is None else last.number,
            "state": None if last is None else last.state,
            "proposed": None if offered is None else offered.number,
        }

    async def _look(self, request: Request) -> Response:
        """What there is; a post fits at once."""

        async def begin(body: Any) -> Response:
            fields_of(body)
            await asyncio.to_thread(self._refits.now)
            return Json(await asyncio.to_thread(self._state), 202)

        if request.method == "POST":
            return await answered(request, begin)
        return Json(await asyncio.to_thread(self._state))

    async def _accept(self, request: Request) -> Response:
        """`{"number": 3}`: keep it as a tuning version, and go on with that."""

        async def work(body: Any) -> Response:
            (number,) = fields_of(body, number=int)
            return Json({"name": await asyncio.to_thread(self._refits.accept, number)})

        return await answered(request, work)

    async def _dismiss(self, request: Request) -> Response:
        """`{"number": 3}`: leave things as they are."""

        async def work(body: Any) -> Response:
            (number,) = fields_of(body, number=int)
            await asyncio.to_thread(self._refits.dismiss, number)
            return Json(self._state())

        return await answered(request, work)

    def _state(self) -> dict[str, Any]:
        """What the YAML says, when the next fit is due, and every fit, the newest first."""
        refits, section = self._refits, self._refits.section
        due = refits.due
        return {
            "section": None if section is None else section.model_dump(mode="json"),
            "due": None if due is None else str(due),
            "fits": [refit_json(item) for item in reversed(refits.known)],
        }


def refit_json(refit: Refit) -> dict[str, Any]:
    """One fit as JSON; times as text, since they are larger than a JavaScript number holds."""
    attempt = refit.attempt
    told: dict[str, Any] = {
        "number": refit.number,
        "state": refit.state,
        "text": one_line(refit.text),
        "name": refit.name,
        "start": str(refit.start),
        "end": str(refit.end),
        "revision": attempt.revision,
        "events": attempt.events,
        "seconds": attempt.seconds,
        "folds": attempt.folds,
        "elapsed": attempt.elapsed,
    }
    if refit.fitted is None or refit.state == FITTING:
        return told
    from ..live.runs.runs_json import fit_json

    return told | {"result": fit_json(refit.fitted)}
