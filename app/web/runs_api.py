"""Runs over HTTP: scores, differences, tuning versions, the likelihood around a parameter, tables and reports."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from starlette.convertors import IntegerConvertor, register_url_convertor
from starlette.requests import Request
from starlette.responses import HTMLResponse, PlainTextResponse, Response, StreamingResponse
from starlette.routing import Route

from config.tunings import NAME
from estimators.diagnostics.episodes import Episode
from estimators.diagnostics.sensitivity.responses import digits
from estimators.errors import ConfigError, printable
from estimators.fold import folded
from estimators.tuning import CHANGED_MARK

from ..charts.chart_stream import Seconds
from ..charts.series import Series
from ..derive.run_scores import RunScores
from ..derive.sweep import Sweeps, noise
from ..engine.engine import Engine
from ..engine.history_copy import copy_log
from ..engine.load_version import load_into
from ..engine.revisions import MAX_NOTE_LENGTH, Revision
from ..render.html import to_html
from ..render.report import Reported, report
from ..render.runs_json import changes_json, noise_json, runs_json, swept_json, what_changed
from ..render.track_file import KINDS, encoded, rows_of_run, tables
from ..result import JsonObject
from ..study.commission import baseline_of, lines, storable, store_baseline
from ..twin.changes import difference
from ..twin.tuning_yaml import tuning_yaml
from ..twin.twin import with_version
from ..twin.versions import Settings, figures, keep, listing, verdicts, version_text
from .http import OneAtATime, get, post

MAX_ERRORS = 6
"""States whose error the report gives for each run."""


class RunNumber(IntegerConvertor):
    """Number of a run in a path; Python refuses to convert thousands of digits."""

    regex = "[0-9]{1,18}"


register_url_convertor("run", RunNumber())


class RunsApi:
    """Routes for runs and tuning versions. Scores and sweeps are computed on request."""

    def __init__(self, engine: Engine, series: Series) -> None:
        self._engine, self._series = engine, series
        self.scores = RunScores(engine)
        self._sweeps = Sweeps(engine)

    def routes(self) -> list[Route]:
        """Return the routes."""
        copying = OneAtATime("export")
        return [
            get("/api/runs", self._runs),
            get("/api/runs/{number:run}.yaml", self._yaml, refused=404),
            get("/api/runs/{number:run}/against/{other:run}", self._difference, refused=404),
            get("/api/around", self._around),
            get("/api/noise", self._noise),
            get("/api/tunings", self._tunings),
            post("/api/tunings", self._keep),
            post("/api/tunings/load", self._load),
            post("/api/baseline", self._baseline, run=OneAtATime("baseline")),
            get("/api/tunings/{name}/against", self._against, refused=404),
            *(get(f"/api/track.{kind}", self._track, refused=409, run=copying) for kind in KINDS),
            get("/api/report.html", self._report, refused=409, run=copying),
        ]

    def _runs(self) -> list[JsonObject]:
        """Return every run with its changes and scores."""
        return runs_json(self.scores, self._engine)

    def _yaml(self, number: int) -> Response:
        """Answer with the twin's YAML with the settings of a run."""
        run, twin = self._engine.revisions.find(number), self._engine.twin
        heading = f"# {twin.name}, run {run.number}" + (f": {run.name}" if run.name else "")
        notes = "".join(f"# {line}\n" for line in run.note.splitlines())
        text = f"{heading}\n{notes}{tuning_yaml(twin.config, run.estimator, run.tuning)}"
        return PlainTextResponse(text, headers=self._attachment(number, ".yaml"))

    def _difference(self, number: int, other: int) -> list[JsonObject]:
        """Return the entries in which two runs differ."""
        one, two = self._engine.revisions.find(number), self._engine.revisions.find(other)
        return changes_json(difference(one.estimator, one.tuning, two.estimator, two.tuning))

    def _around(self, key: str = "") -> JsonObject:
        """Return the likelihood around the value of an entry."""
        return swept_json(self._sweeps.around(key))

    def _noise(self) -> JsonObject:
        """Return R and Q as estimated from the innovations."""
        return noise_json(noise(self._engine, self._sweeps))

    # Tuning versions

    def _tunings(self) -> JsonObject:
        """List the tuning versions."""
        twin = self._engine.twin
        return {"running": self._engine.status().tuning.name, "versions": listing(twin), "guard": verdicts(twin.path)}

    def _keep(self, run: int, name: str, note: str) -> JsonObject:
        """Keep a run as a version, with its scores."""
        kept, twin = self._engine.revisions.find(run), self._engine.twin
        known = next((known for other, known in self.scores.all() if other.number == run), None)
        settings = Settings(
            kept.estimator,
            kept.tuning,
            note=checked_note(note),
            scores={} if known is None else figures(known.score),
            model_version=self._engine.status().model_version,
        )
        keep(twin, name, version_text(twin, settings))
        return {"name": name}

    def _load(self, name: str) -> JsonObject:
        """Load a version; the history is folded again with it."""
        load_into(self._engine, _listed(name))
        return {"name": name}

    def _against(self, name: str) -> list[JsonObject]:
        """List the entries in which a version differs from the running tuning."""
        tuning, estimator = self._engine.folded_with()
        twin = with_version(self._engine.twin, _listed(name))
        return changes_json(difference(twin.estimator, twin.tuning, estimator, tuning))

    def _baseline(self, force: bool = False) -> JsonObject:
        """Write the baseline of the running tuning into the twin's file, which is then read again."""
        return {"file": commission_running(self._engine, force=force).name}

    # Files: of a copy of the rows, so that writing holds up no other reader.

    def _track(
        self, request: Request, run: int | None = None, since: Seconds | None = None, until: Seconds | None = None
    ) -> Response:
        """Answer with the rows of a run (default: the running one) between two times of the charts, s."""
        rows = rows_of_run(self._engine, run)
        kind = request.url.path.rpartition(".")[2]
        origin = self._series.origin() or 0
        start, end = (None if at is None else origin + round(at * 1e9) for at in (since, until))
        parts = encoded(kind, tables(rows, rows.between(start, end)))
        ends = (request.query_params.get(name, "") for name in ("since", "until"))
        span = f"-{'-to-'.join(ends)}s" if {"since", "until"} & request.query_params.keys() else ""
        headers = self._attachment(rows.run.number, f"{span}.{kind}")
        return StreamingResponse(parts, media_type=KINDS[kind], headers=headers)

    def _report(self, run: int | None = None) -> Response:
        """Answer with the report of a run (default: the running one) as one file."""
        engine, rows = self._engine, rows_of_run(self._engine, run)
        found, pull = rows
        status = engine.status().integrity
        bounds = status.bounds if status is not None and status.revision == found.number else None
        about = [("run", f"{found.number}" + (f", {found.name}" if found.name else "") + f": {self._what(found)}")]
        if found.note:
            about.append(("note", found.note))
        # The running one's episodes name the most likely cause, as the page does.
        episodes = engine.episodes() if found is engine.revisions.runs[-1] else rows.episodes()
        reported = Reported(
            engine.twin, found.estimator, found.tuning, pull.events, pull.track, pull.pictures, episodes,
            rows.marginal, tuple(about), bounds, _scored(self.scores), self._earlier(found, episodes),
            annotations=engine.annotations.notes,
        )  # fmt: skip
        text = to_html(f"{engine.twin.name}, run {found.number}", report(reported))
        return HTMLResponse(text, headers=self._attachment(found.number, ".html"))

    def _earlier(self, run: Revision, now: Sequence[Episode]) -> tuple[tuple[str, Sequence[Episode]], ...]:
        """Return the episodes of earlier runs that no later run has as well, newest run first."""
        known, found = {(item.subject, item.cause) for item in now}, []
        for other in reversed(self._engine.revisions.runs):
            new = [item for item in other.episodes if (item.subject, item.cause) not in known]
            if new and other.number < run.number:
                known |= {(item.subject, item.cause) for item in new}
                found.append((f"{other.number} {other.name}".rstrip() + f": {self._what(other)}", new))
        return tuple(found)

    def _what(self, run: Revision) -> str:
        return what_changed(run, {other.number for other in self._engine.revisions.runs})

    def _attachment(self, number: int, rest: str) -> dict[str, str]:
        """Return the header that names a file of a run."""
        name = re.sub(r"[^\w.-]+", "_", f"{self._engine.twin.name}-run{number}{rest}", flags=re.ASCII)
        return {"Content-Disposition": f'attachment; filename="{name}"'}


def checked_note(note: str) -> str:
    """Return a note without control characters.

    Raises:
        ConfigError: If it is too long.
    """
    if len(note) > MAX_NOTE_LENGTH:
        raise ConfigError(f"note: it has {len(note)} characters; it may have {MAX_NOTE_LENGTH}")
    return printable(note)


def _listed(name: str) -> str:
    """Check that it is a name, not a path: a page chooses among the versions beside the twin."""
    if not NAME.fullmatch(name) or name.endswith((".yaml", ".yml")):
        raise ConfigError(f"{name}: no version is read from there; name one that /api/tunings lists")
    return name


def _scored(scores: RunScores) -> tuple[tuple[str, ...], ...]:
    """Return a line for each run: name, change, NIS, log-likelihood, errors."""
    lines, found = [], scores.all()
    there = {run.number for run, _ in found}
    for run, known in found:
        line = "", "", "not scored: its track is gone"
        if known is not None:
            fits = [*{**known.score.states, **known.score.held_out}.items()][:MAX_ERRORS]
            errors = ", ".join(f"{subject} {digits(fit.rmse)}" for subject, fit in fits)
            line = digits(known.score.nis_verdict.ratio), f"{known.score.log_likelihood_reading:.4g}", errors
        lines.append((f"{run.number} {run.name}".rstrip(), what_changed(run, there), *line))
    return tuple(lines)


def commission_running(engine: Engine, *, force: bool) -> Path:
    """Write the baseline of the running tuning over its whole history into the twin's file; return the file.

    Raises:
        ConfigError: If the tuning has edits that the file does not have, or as `baseline_of` and `store_baseline`.
    """
    twin, (tuning, estimator) = engine.twin, engine.folded_with()
    if not storable(twin):
        raise ConfigError(f"{twin.name}: only a twin with a YAML file of its own can store a baseline")
    if tuning.name.endswith(CHANGED_MARK):
        raise ConfigError(f"{twin.name}: its tuning has been edited; save it first, or undo the edits")
    log, base = copy_log(engine, tuning)
    fold = folded(estimator, engine.model, replace(tuning, baseline=None), log, policy=engine.policy, base=base)
    normals = baseline_of(fold, twin.name, force=force, option="Store anyway")
    return store_baseline(twin, lines(normals))
