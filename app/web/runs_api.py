"""Runs over HTTP: their scores, what differs between two, their tuning as YAML, and what the data say of a knob."""

from __future__ import annotations

import asyncio

from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route

from estimators.errors import ConfigError

from ..live.interface import Running
from ..live.revisions import Run
from ..live.runs.noise import noise
from ..live.runs.runs_json import difference_json, noise_json, runs_json, swept_json
from ..live.runs.scores import RunScores
from ..live.runs.sweep import Sweeps
from ..live.tunings.tuning_yaml import tuning_yaml
from .api import Json, one_line


class RunsApi:
    """The routes, and the threads behind them. What nobody asks for is not computed."""

    def __init__(self, engine: Running) -> None:
        self._engine = engine
        self.scores = RunScores(engine)
        self._sweeps = Sweeps(engine)

    def start(self) -> None:
        """Be ready to sweep."""
        self._sweeps.start()

    def stop(self) -> None:
        """End what is under way."""
        self._sweeps.stop()

    def routes(self) -> list[Route]:
        """What is served."""
        return [
            Route("/api/runs", self._runs),
            Route("/api/runs/{number:int}.yaml", self._yaml),
            Route("/api/runs/{number:int}/against/{other:int}", self._difference),
            Route("/api/around", self._around),
            Route("/api/noise", self._noise),
        ]

    async def _runs(self, request: Request) -> Response:
        return Json(await asyncio.to_thread(runs_json, self.scores, self._engine))

    async def _yaml(self, request: Request) -> Response:
        try:
            run = self._run(request, "number")
        except ConfigError as error:
            return _refused(error, 404)
        twin = self._engine.twin
        heading = f"# {twin.name}, run {run.number}" + (f": {run.name}" if run.name else "")
        notes = "".join(f"# {line}\n" for line in run.note.splitlines())
        text = f"{heading}\n{notes}{tuning_yaml(twin.config, run.estimator, run.tuning)}"
        name = f"{twin.name}-run{run.number}.yaml"
        return PlainTextResponse(text, headers={"Content-Disposition": f'attachment; filename="{name}"'})

    async def _difference(self, request: Request) -> Response:
        try:
            return Json(difference_json(self._run(request, "number"), self._run(request, "other")))
        except ConfigError as error:
            return _refused(error, 404)

    async def _around(self, request: Request) -> Response:
        try:
            swept = await asyncio.to_thread(self._sweeps.around, request.query_params.get("key", ""))
            return Json(swept_json(swept))
        except ConfigError as error:
            return _refused(error, 400)

    async def _noise(self, request: Request) -> Response:
        return Json(noise_json(await asyncio.to_thread(noise, self._engine, self._sweeps)))

    def _run(self, request: Request, name: str) -> Run:
        return self._engine.revisions.find(request.path_params[name])


def _refused(error: ConfigError, status: int) -> Response:
    return Json({"error": one_line(str(error))}, status)
