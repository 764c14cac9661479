"""What can be saved of a run over HTTP: its track as a table, and a report of it."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

from starlette.requests import Request
from starlette.responses import HTMLResponse, Response, StreamingResponse
from starlette.routing import Route

from estimators.diagnostics.episodes import Episode
from estimators.diagnostics.sensitivity.responses import digits
from estimators.errors import ConfigError

from ..live.interface import Running
from ..live.revisions import Run
from ..live.runs.runs_json import what_changed
from ..live.runs.scores import RunScore, RunScores
from ..present.export.report import Reported, report
from ..present.export.run_rows import RunRows, rows_of_run
from ..present.export.track_file import KINDS, encoded, tables
from ..present.result import to_html
from ..present.series.series import Series
from .api import Json, one_line
from .one_at_a_time import OneAtATime

LONGEST = 1e9
"""Seconds that can be asked for, to either side, at most."""

MOST_FITS = 6
"""States whose error is told of each run."""


class ExportApi:
    """The routes. A copy of the rows is taken first, by pieces; what is written of it holds nobody up."""

    def __init__(self, engine: Running, series: Series, scores: RunScores) -> None:
        self._engine, self._series, self._scores = engine, series, scores
        self._copying = OneAtATime("export")

    def routes(self) -> list[Route]:
        """What is served."""
        return [
            *(Route(f"/api/track.{kind}", self._track) for kind in KINDS),
            Route("/api/report.html", self._report),
        ]

    async def _track(self, request: Request) -> Response:
        """`?run=3&since=0&until=12.5`: of a run (default: what runs) the rows between two times, s of the charts."""
        kind = request.url.path.rpartition(".")[2]
        try:
            number = _number(request)
            since, until = (self._instant(request, name) for name in ("since", "until"))
            taken = await self._copying.do(lambda: rows_of_run(self._engine, number))
        except ConfigError as error:
            return Json({"error": one_line(str(error))}, 409)
        parts = encoded(kind, tables(taken, taken.between(since, until)))
        return StreamingResponse(parts, media_type=KINDS[kind], headers=self._named(taken, kind, request))

    async def _report(self, request: Request) -> Response:
        """`?run=3`: of a run (default: what runs) all there is to say, as one file."""
        try:
            number = _number(request)
            taken, text = await self._copying.do(lambda: self._reported(number))
        except ConfigError as error:
            return Json({"error": one_line(str(error))}, 409)
        return HTMLResponse(text, headers=self._named(taken, "html", request))

    def _reported(self, number: int | None) -> tuple[RunRows, str]:
        engine, taken = self._engine, rows_of_run(self._engine, number)
        run, pull = taken
        found = engine.status().integrity
        bounds = found.bounds if found is not None and found.revision == run.number else None
        about = [("run", f"{run.number}" + (f", {run.name}" if run.name else "") + f": {what_changed(run)}")]
        if run.note:
            about.append(("note", run.note))
        # Of what runs, with who is to blame, as the page says it.
        episodes = engine.episodes() if run is engine.revisions.runs[-1] else taken.episodes()
        said = Reported(
            engine.twin, run.estimator, run.tuning, pull.events, pull.track, pull.pictures, episodes,
            taken.marginal, tuple(about), bounds, _others(self._scores), self._before(run, episodes),
        )  # fmt: skip
        return taken, to_html(f"{engine.twin.name}, run {run.number}", report(said))

    def _before(self, run: Run, now: Sequence[Episode]) -> tuple[tuple[str, Sequence[Episode]], ...]:
        """The episodes of earlier runs that this one, or a later of them, does not have as well, newest run first."""
        known, found = {_who(item) for item in now}, []
        for other in reversed(self._engine.revisions.runs):
            new = [item for item in other.episodes if other.number < run.number and _who(item) not in known]
            if new:
                known |= {_who(item) for item in new}
                found.append((f"{other.number} {other.name}".rstrip() + f": {what_changed(other)}", new))
        return tuple(found)

    def _instant(self, request: Request, name: str) -> int | None:
        """A time of the charts as one of the log, ns."""
        text = request.query_params.get(name)
        if text is None:
            return None
        try:
            seconds = float(text)
        except ValueError:
            seconds = math.nan
        if not abs(seconds) < LONGEST:
            raise ConfigError(f"track: {name} is {text[:40]!r}; it must be a number of seconds")
        return (self._series.origin() or 0) + round(seconds * 1e9)

    def _named(self, taken: RunRows, kind: str, request: Request) -> dict[str, str]:
        ends = [request.query_params.get(name) for name in ("since", "until")]
        span = f"-{ends[0] or ''}-to-{ends[1] or ''}s" if any(ends) else ""
        name = re.sub(r"[^\w.-]+", "_", f"{self._engine.twin.name}-run{taken.run.number}{span}", flags=re.ASCII)
        return {"Content-Disposition": f'attachment; filename="{name}.{kind}"'}


def _who(episode: Episode) -> tuple[str, str]:
    return episode.subject, episode.cause


def _others(scores: RunScores) -> tuple[tuple[str, ...], ...]:
    """What every run was worth, in words."""

    def line(run: Run, known: RunScore | None) -> tuple[str, ...]:
        name = f"{run.number} {run.name}".rstrip()
        if known is None:
            return name, what_changed(run), "", "", "not scored: its track is gone"
        fits = {**known.score.states, **known.score.held_out}
        errors = ", ".join(f"{subject} {digits(fit.rmse)}" for subject, fit in list(fits.items())[:MOST_FITS])
        return name, what_changed(run), digits(known.score.nis), f"{known.log_likelihood_reading:.4g}", errors

    return tuple(line(run, known) for run, known in scores.all())


def _number(request: Request) -> int | None:
    text = request.query_params.get("run")
    if text is None:
        return None
    if not re.fullmatch(r"[0-9]{1,9}", text):
        raise ConfigError(f"track: run is {text[:40]!r}; it must be the number of a run")
    return int(text)
