"""Diagnosis of a running twin: innovations, particles, covariance, observability, faults, cost."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from estimators.diagnostics.considered_shares import source_texts
from estimators.diagnostics.innovations import flat_range
from estimators.diagnostics.score import nis_verdict
from estimators.diagnostics.sensitivity import GramianView, gramian
from estimators.log import Events
from estimators.model.state_space import LARGE
from estimators.registry import find_entry
from estimators.track import Track

from ..engine.copies import EventWindow, Status
from ..engine.fault_monitors import reason_against
from ..engine.jobs import Job, PacedExecutor
from ..engine.running_fold import Running
from ..result import JsonObject
from .row_figures import listed, number, rows_json

DIAGNOSED_ROWS = 20_000  # last rows that are analysed
REUSE_S = 1.0  # seconds for which an answer is reused, for all clients
LINE_POINTS = 200  # points of a line over time
MAX_CORRELATED_STATES = 48  # states of a correlation map


FIGURES_PERIOD_S = 20.0  # seconds between two computations of the fold figures
COST_TIME_S = 0.25  # seconds of work after which the cost of a step is known well enough

COST_CHUNK = 64


@dataclass(frozen=True)
class FoldFigures:
    """Cost of an event (µs) and observability of one revision, or the reason why there is none.

    `note` qualifies the observability.
    """

    revision: int
    cost: float
    observability: GramianView | None
    reason: str
    note: str = ""


class FoldFigureCache:
    """Computes the figures that take many folds when asked, at most once every `FIGURES_PERIOD_S`."""

    def __init__(self, engine: Running) -> None:
        self._engine = engine
        self._latest: FoldFigures | None = None
        self._job: Job | None = None
        self._wanted: int | None = None

    def of(self, revision: int) -> FoldFigures | None:
        """Return the latest figures if they are of this revision; begin to compute new ones where it is time."""
        job = self._job
        if job is None or (job.over and (time.monotonic() - job.begun > FIGURES_PERIOD_S or revision != self._wanted)):
            self._wanted = revision
            self._job = self._engine.jobs.run("diagnosis", self._work, failed=self._fail)
        latest = self._latest
        return latest if latest is not None and latest.revision == revision else None

    def _work(self, job: Job) -> None:
        taken = self._engine.last_events()
        if taken is None:
            self._wanted = None
        else:
            self._latest = fold_figures(taken, job)

    def _fail(self, reason: str) -> None:
        assert self._wanted is not None
        self._latest = FoldFigures(self._wanted, float("nan"), None, reason)


def fold_figures(taken: EventWindow, job: Job) -> FoldFigures:
    """Fold a window again, for its cost and with every state nudged."""
    fold = taken.fold()
    begun = time.thread_time()
    while fold.advance(COST_CHUNK) and time.thread_time() - begun < COST_TIME_S:
        job.check()
    cost = 1e6 * (time.thread_time() - begun) / max(1, fold.n)
    reason = reason_against(fold.model, taken.estimator)
    if reason:
        return FoldFigures(taken.revision, cost, None, reason)
    log, executor = taken.log(), PacedExecutor(job)
    found = gramian(taken.estimator, fold.model, taken.tuning, log, base=taken.base, windows=0, executor=executor)
    return FoldFigures(taken.revision, cost, found.whole, found.reason, found.note)


class Diagnosis:
    """Answers `GET /api/diagnose`; from any thread but the engine's, one question at a time."""

    def __init__(self, engine: Running) -> None:
        self._engine, self._figures = engine, FoldFigureCache(engine)
        self._known: tuple[float, JsonObject] | None = None

    def figures(self) -> JsonObject:
        """Return the figures of the last rows, at most `REUSE_S` seconds old.

        `rows` are the first of the sensors' rows (row_figures.py), `rows_in_all` how many there are, `ranks` counts of
        an ensemble's histogram, `particles` what is left of a cloud over time, `correlation` a map of the present
        covariance, `variance` sources of the present variance by state, `gain` what a measurement of one of them would
        leave, `nis` how the mean NIS is judged, `observability`, `faults` and `integrity` what could be wrong
        unnoticed, `cost` microseconds of an event.
        """
        known = self._known
        if known is None or time.monotonic() - known[0] > REUSE_S:
            answer = self._look()
            self._known = known = time.monotonic(), answer
        return known[1]

    def _look(self) -> JsonObject:
        engine = self._engine
        tuning, estimator = engine.folded_with()
        end = engine.end()
        pull = engine.rows(end - DIAGNOSED_ROWS, end)
        revision, events, track = pull.revision, pull.events, pull.track
        status = engine.status()
        marginal = find_entry(estimator).marginal
        slow = self._figures.of(revision) if len(events) else None
        nis = nis_verdict(track, events, engine.model, tuning.baseline)
        sources = source_texts(engine.model, engine.belief().cov) if engine.model.considered else {}
        return {
            "revision": revision,
            "estimator": estimator,
            "events": len(events),
            "span": events.seconds,
            "marginal": marginal,
            "rows": _agreed(rows_json(engine.model, events, track, tuning, marginal=marginal), status),
            "rows_in_all": len(engine.model.row_names),
            "ranks": _ranks(status),
            "particles": _particles(status, events, track),
            "correlation": _correlation(engine),
            "variance": {name: source for name, (source, _) in sources.items()},
            "gain": {name: gain for name, (_, gain) in sources.items()},
            "observability": _observability(engine, slow),
            "nis": nis.words,
            "nis_place": nis.place,
            "cost": None if slow is None else number(slow.cost, 3),
            **_unseen(status),
        }


def _agreed(rows: list[JsonObject], status: Status) -> list[JsonObject]:
    """Return the rows; none is called good while the detectors report an episode about it."""
    for row in rows:
        state, text = status.sensors.get(row["sensor"], ("", ""))
        if row["tone"] == "good" and state in ("suspect", "degraded", "diverged") and row["name"] in text:
            row["verdict"], row["tone"] = f"{row['name']}: {text}", "bad"
    return rows


def _ranks(status: Status) -> JsonObject | None:
    """Return the rank histogram of an ensemble since its start."""
    counts = status.account.get("ranks")
    if not isinstance(counts, list) or not sum(counts):
        return None
    low, high = flat_range(int(sum(counts)), len(counts))
    return {"counts": counts, "low": number(low), "high": number(high)}


def _particles(status: Status, events: Events, track: Track) -> JsonObject | None:
    """Return the effective number of particles and of their ancestors over time: the minimum of each stretch."""
    rows = np.flatnonzero(np.isfinite(track.effective))
    if not rows.size:
        return None
    cuts = np.unique(np.linspace(0, rows.size, min(LINE_POINTS, rows.size) + 1).astype(int))[:-1]
    ago = (events.t[rows[cuts]] - events.t[-1]) * 1e-9
    lines = {
        name: listed(np.minimum.reduceat(np.nan_to_num(column[rows], nan=np.inf), cuts), 4)
        for name, column in (("effective", track.effective), ("ancestors", track.ancestors))
    }
    said = {name: number(value) for name, value in status.account.items() if isinstance(value, float)}
    return {"t": listed(ago, 5), **lines, "count": said.get("particles"), "lag": said.get("lag")}


def _correlation(engine: Running) -> JsonObject:
    """Return the correlations of the present covariance by shown state, or the reason why there are none."""
    model = engine.model
    cov = engine.belief().cov
    if model.nx > LARGE or cov.shape[0] != model.nx:
        return {"names": [], "matrix": [], "reason": f"{model.nx:,} states have no covariance matrix, but variances"}
    places = model.shown[:MAX_CORRELATED_STATES]
    some = cov[np.ix_(places, places)]
    std = np.sqrt(np.diag(some))
    with np.errstate(all="ignore"):
        matrix = some / np.outer(std, std)
    names = [model.shown_states[k].name for k in range(len(places))]
    own = model.nx - model.considered
    left = "" if len(places) == own else f"{len(places)} of {own:,} states"
    return {"names": names, "matrix": listed(matrix, 3), "reason": left}


def _observability(engine: Running, found: FoldFigures | None) -> JsonObject:
    if found is None:
        return {"reason": "being computed", "states": {}}
    view = found.observability
    if view is None:
        return {"reason": found.reason, "states": {}}
    return {
        "reason": "",
        "note": found.note,
        "rank": view.rank,
        "of": engine.model.nx,
        "conditioning": number(view.conditioning, 3),
        "states": dict(zip(engine.model.state_names, listed(view.left, 3), strict=True)),
        "weakest": view.text,
        "span": float(view.end - view.begin) * 1e-9,
    }


def _unseen(status: Status) -> JsonObject:
    """Return the minimal detectable faults and the protection level of each state."""
    found = status.integrity
    if found is None:
        return {"faults": [], "integrity": {}, "unseen_reason": "being computed"}
    return {
        "faults": [{**item._asdict(), "share": number(item.share, 3)} for item in found.smallest],
        "integrity": {
            name: {
                "bound": number(item.bound, 3),
                "two_sigma": number(item.two_sigma, 3),
                "unit": item.unit,
                "fault": item.fault,
            }
            for name, item in found.bounds.items()
        },
        "unseen_reason": found.reason,
    }
