"""What is wrong with a running twin, in figures: innovations, particles, covariance, observability, faults, cost."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from estimators.diagnostics.innovations import flat_range
from estimators.diagnostics.score import nis_verdict
from estimators.log import Events
from estimators.model.state_space import LARGE
from estimators.registry import find_entry
from estimators.track import Track

from ...live.interface import Running
from ...live.outputs import Status
from .numbers import listed, number
from .row_figures import rows_json
from .slow import Found, Slow

ROWS = 20_000
"""Rows that are looked at, the last."""

PIECE = 4096
"""Rows that are copied at once: the engine waits for no more."""

FRESH = 1.0
"""Seconds for which an answer holds, for all who look."""

POINTS = 200
"""Points of a line over time."""

MOST_NAMES = 48
"""States of a correlation map."""


class Diagnosis:
    """Answers `GET /api/diagnose`; from any thread but the engine's, one question at a time."""

    def __init__(self, engine: Running) -> None:
        self._engine, self._slow = engine, Slow(engine)
        self._known: tuple[float, dict[str, Any]] | None = None

    def look(self) -> dict[str, Any]:
        """The figures of the last rows, at most `FRESH` seconds old.

        `rows` are the first of the sensors' rows (row_figures.py), `rows_in_all` how many there are, `ranks` counts of
        an ensemble's histogram, `particles` what is left of a cloud over time, `correlation` a map of the present
        covariance, `nis` how the mean NIS is judged,
        `observability`, `faults` and `integrity` what could be wrong unnoticed, `cost` microseconds of an
        event.
        """
        known = self._known
        if known is None or time.monotonic() - known[0] > FRESH:
            answer = self._look()
            self._known = known = time.monotonic(), answer
        return known[1]

    def _look(self) -> dict[str, Any]:
        engine = self._engine
        tuning, estimator = engine.folded_with()
        revision, events, track = last_rows(engine, ROWS)
        status = engine.status()
        marginal = find_entry(estimator).family in ("particle", "ensemble")
        slow = self._slow.of(revision) if len(events) else None
        nis = nis_verdict(track, events, engine.model, tuning.baseline)
        return {
            "revision": revision,
            "estimator": estimator,
            "events": len(events),
            "span": float(events.t[-1] - events.t[0]) * 1e-9 if len(events) else 0.0,
            "marginal": marginal,
            "rows": _agreed(rows_json(engine.model, events, track, tuning, marginal=marginal), status),
            "rows_in_all": len(engine.model.row_names),
            "ranks": _ranks(status),
            "particles": _particles(status, events, track),
            "correlation": _correlation(engine),
            "observability": _observability(engine, slow),
            "nis": nis.words,
            "nis_place": nis.place,
            "cost": None if slow is None else number(slow.cost, 3),
            **_unseen(status),
        }


def last_rows(engine: Running, most: int) -> tuple[int, Events, Track]:
    """Copies of the last rows of one revision: its number, events and track.

    In pieces, so that the engine never waits for long; a late reading between two of them may show in one only.
    """
    end = engine.index_at(2**62)
    pieces = [engine.rows(end - most, end - most)]
    for start in range(max(0, end - most), end, PIECE):
        piece = engine.rows(start, min(start + PIECE, end))
        if piece.revision != pieces[0].revision:
            return last_rows(engine, most)
        pieces.append(piece)
    events = Events.concat([piece.events for piece in pieces], engine.model.width)
    track = Track(*(np.concatenate(columns) for columns in zip(*(piece.track for piece in pieces), strict=True)))
    return pieces[0].revision, events, track


def _agreed(rows: list[dict[str, Any]], status: Status) -> list[dict[str, Any]]:
    """The rows, of which none is called good while the twin's own tests say what is wrong with it."""
    for row in rows:
        state, text = status.sensors.get(row["sensor"], ("", ""))
        if row["tone"] == "good" and state in ("suspect", "degraded", "diverged") and row["name"] in text:
            row["verdict"], row["tone"] = f"{row['name']}: {text}", "bad"
    return rows


def _ranks(status: Status) -> dict[str, Any] | None:
    """The rank histogram that an ensemble keeps since it started."""
    counts = status.account.get("ranks")
    if not isinstance(counts, list) or not sum(counts):
        return None
    low, high = flat_range(int(sum(counts)), len(counts))
    return {"counts": counts, "low": number(low), "high": number(high)}


def _particles(status: Status, events: Events, track: Track) -> dict[str, Any] | None:
    """How many particles count, and from how many they descend: the least in each stretch of the rows."""
    rows = np.flatnonzero(np.isfinite(track.effective))
    if not rows.size:
        return None
    cuts = np.unique(np.linspace(0, rows.size, min(POINTS, rows.size) + 1).astype(int))[:-1]
    ago = (events.t[rows[cuts]] - events.t[-1]) * 1e-9
    lines = {
        name: listed(np.minimum.reduceat(np.nan_to_num(column[rows], nan=np.inf), cuts), 4)
        for name, column in (("effective", track.effective), ("ancestors", track.ancestors))
    }
    said = {name: number(value) for name, value in status.account.items() if isinstance(value, float)}
    return {"t": listed(ago, 5), **lines, "count": said.get("particles"), "lag": said.get("lag")}


def _correlation(engine: Running) -> dict[str, Any]:
    """The correlations of the present covariance by shown state, or why there are none."""
    model = engine.model
    cov = engine.belief().cov
    if model.nx > LARGE or cov.shape[0] != model.nx:
        return {"names": [], "matrix": [], "reason": f"{model.nx:,} states have no covariance matrix, but variances"}
    places = model.shown[:MOST_NAMES]
    some = cov[np.ix_(places, places)]
    std = np.sqrt(np.diag(some))
    with np.errstate(all="ignore"):
        matrix = some / np.outer(std, std)
    names = [model.shown_states[k].name for k in range(len(places))]
    left = "" if len(places) == model.nx else f"{len(places)} of {model.nx:,} states"
    return {"names": names, "matrix": listed(matrix, 3), "reason": left}


def _observability(engine: Running, found: Found | None) -> dict[str, Any]:
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
        "states": dict(zip(engine.model.state_names, listed(view.deviation, 3), strict=True)),
        "weakest": view.text,
        "span": float(view.end - view.begin) * 1e-9,
    }


def _unseen(status: Status) -> dict[str, Any]:
    """The smallest faults that are seen, and how wrong each state can be by one that is not."""
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
