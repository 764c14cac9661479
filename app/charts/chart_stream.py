"""Columns of one run between two times, in no more points than a chart can show.

A stream remembers what it has sent and gives only groups of rows that are new or have changed since.
"""

from __future__ import annotations

import json
import math
import struct
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import ConfigDict, Field

from estimators.errors import ConfigError

from ..columns import DOTS, LOWER, UPPER, Column
from .charted_run import ChartedRun
from .levels_of_detail import FACTOR, FIRST, NEVER, Groups

MAX_DOT_ROWS = 20_000
"""Rows up to which every dot is drawn; of more, a random sample of as many and the extremes of each group."""

SLACK = 1.3
"""Factor by which the number of groups may leave its bounds before their size changes: charts would flicker."""

Seconds = Annotated[float, Field(gt=-1e9, lt=1e9)]


@dataclass(frozen=True)
class ChartQuery:
    """Columns that a browser asks for; `columns_of` lists them.

    `run` is "live", "previous", "smoothed", the number of a pinned run, or "difference:" and such a number. Times are
    seconds since the first event; `since` None is the first, `until` None the newest, and with `span` the last seconds
    are followed. `points` is the largest number of groups.
    """

    __pydantic_config__ = ConfigDict(extra="forbid")

    columns: Annotated[tuple[str, ...], Field(max_length=400)]
    run: str = "live"
    since: Seconds | None = None
    until: Seconds | None = None
    span: Seconds | None = None
    points: Annotated[int, Field(ge=2, le=4000)] = 600


class ChartStream:
    """Frames for one query of one browser."""

    def __init__(self, name: str, query: ChartQuery, columns: dict[str, Column]) -> None:
        """Take a query.

        Raises:
            ConfigError: If there is no such column.
        """
        unknown = next((column for column in query.columns if column not in columns), None)
        if unknown is not None:
            raise ConfigError(f"stream {name}: there is no column {unknown!r}; /api/model lists them")
        self.name, self.query = name, query
        self._kinds = np.array([columns[column].kind for column in query.columns])
        self.size = 0
        """Rows in a group."""
        self._every_dot = False
        self._rows = (0, 0)
        """Rows that the query covers: the first, and the one after the last."""
        self._sent, self._end = (0, 0), 0
        """Groups that the browser has, from the first to before the second; the row after their last."""
        self._sent_as: object = None
        """Run, generation, group size and choice of dots of those."""
        self._dirty = NEVER
        """First row that has changed since the last frame."""
        self._offsets = np.full(len(query.columns), np.nan)

    def mark_changed(self, row: int) -> None:
        """Note that rows from this one on are new or have changed."""
        self._dirty = min(self._dirty, row)

    def select(self, run: ChartedRun, origin: int, newest: int) -> None:
        """Find the rows that the query covers, and the size of their groups; the run's levels need not be up to date.

        `origin` and `newest` are the times of the first event, from which seconds count, and of the last one, ns.
        """
        query = self.query
        until = newest if query.until is None else min(newest, _instant(origin, query.until))
        since = _instant(origin, query.since) if query.since is not None else origin
        if query.span is not None:
            since = max(since, until - round(query.span * 1e9))
        # One more row on either side, so that lines leave the chart at its edges.
        start, stop = run.span(since, until + 1)
        self._rows = max(0, start - 1), stop + 1
        rows = self._rows[1] - self._rows[0]
        self.size = self._sized(rows)
        self._every_dot = rows <= MAX_DOT_ROWS * (SLACK if self._every_dot else 1.0)

    @property
    def levelled(self) -> tuple[str, ...]:
        """Columns that need levels of detail: none while groups are small enough to be made of rows."""
        return self.query.columns if self.size >= FIRST else ()

    def frame(self, run: ChartedRun, origin: int) -> bytes | None:
        """Return the changes since the last frame, or None; the levels of the run must be up to date."""
        (start, stop), size = self._rows, self.size
        sent_as = (run, run.generation, size, self._every_dot)
        end = min(stop, run.end)
        if end > self._end:
            # Rows may have arrived after `select`.
            self.mark_changed(self._end)
        first, last = start // size, -(-end // size)
        have_first, have_last = self._sent
        fresh = sent_as != self._sent_as or first < have_first or first > have_last
        at = first if fresh else min(have_last, self._dirty // size)
        at = max(first, min(at, last))
        if not fresh and (at >= last or self._dirty >= run.end):
            return None
        groups = run.groups(size, at, last, list(self.query.columns))
        samples = self._samples(run, groups)
        self._sent_as, self._dirty, self._end = sent_as, NEVER, end
        # The last group may grow.
        self._sent = (first, groups.start + groups.n)
        return self._packed(groups, samples, origin, fresh, first, run.revision)

    def _samples(self, run: ChartedRun, groups: Groups) -> tuple[np.ndarray, np.ndarray] | None:
        """Return times and values of the dots within each group; None if there are none beside its extremes."""
        dots = [name for name, kind in zip(self.query.columns, self._kinds, strict=True) if kind == DOTS]
        count = groups.size if self._every_dot else min(groups.size, MAX_DOT_ROWS // self.query.points)
        return run.samples(groups, dots, count) if dots and groups.size > 1 and count else None

    def _sized(self, rows: int) -> int:
        """Return the size of groups: the smallest that the points allow, or the last one if that nearly does."""
        points = self.query.points
        kept = self.size
        if kept and rows <= SLACK * points * kept and (kept == 1 or rows * SLACK > points * kept / FACTOR):
            return kept
        size = 1
        while rows > points * size:
            size *= FACTOR
        return size

    def _packed(
        self,
        groups: Groups,
        samples: tuple[np.ndarray, np.ndarray] | None,
        origin: int,
        fresh: bool,
        first: int,
        revision: int,
    ) -> bytes:
        times, values = drawn(groups, self._kinds)
        dots = self._kinds == DOTS
        points = values[:, dots]
        each = ends = 1 if groups.size == 1 else 2
        if samples is not None:
            # The rows lie between the two points of their group, which are its extremes unless all rows are there.
            inner, between = samples
            each = 2 + inner.shape[1]
            edges = points.reshape(groups.n, 2, -1)
            if inner.shape[1] == groups.size:
                edges = np.full_like(edges, np.nan)
            times = np.concatenate((groups.first[:, None], inner, groups.last[:, None]), axis=1).ravel()
            points = np.concatenate((edges[:, :1], between, edges[:, 1:]), axis=1).reshape(times.size, -1)
        seconds = (times - origin) * 1e-9
        # Single precision around a value of each column: positions on the earth need more than it holds.
        unknown = np.isnan(self._offsets)
        self._offsets[unknown] = [_some(column) for column in values.T[unknown]]
        rebased = fresh or bool((unknown & ~np.isnan(self._offsets)).any())
        offsets = np.nan_to_num(self._offsets)
        # A row is a measurement of one sensor: of dots only those that exist are sent.
        found = [np.flatnonzero(np.isfinite(column)) for column in points.T]
        header = json.dumps(
            {
                "stream": self.name,
                "revision": revision,
                "run": self.query.run,
                "fresh": fresh,
                "first": first,
                "start": groups.start,
                "each": each,
                "ends": ends,
                "size": groups.size,
                "points": int(seconds.size),
                "columns": list(self.query.columns) if fresh else None,
                "dots": [int(is_dots) for is_dots in dots],
                "counts": [len(rows) for rows in found],
                "offsets": offsets.tolist() if rebased else None,
            },
            separators=(",", ":"),
        ).encode()
        header += b" " * (-(len(header) + 4) % 8)
        parts = [struct.pack("<I", len(header)), header, seconds.astype("<f8").tobytes()]
        parts.append((values - offsets)[:, ~dots].astype("<f4").T.tobytes())
        for rows, column, offset in zip(found, points.T, offsets[dots], strict=True):
            parts += [rows.astype("<u4").tobytes(), (column[rows] - offset).astype("<f4").tobytes()]
        return b"".join(parts)


def drawn(groups: Groups, kinds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return points of groups: times (k,) and values (k, columns), one for a group of one row, else two.

    The two are a line's extremes in the order in which they lead on to the next; the edge of a band is twice its outer
    extreme; a dot that is alone in its group is drawn once.
    """
    if groups.size == 1:
        return groups.first, groups.high
    times = np.stack((groups.first, groups.last), axis=1).ravel()
    first = np.where(groups.rising, groups.low, groups.high)
    second = np.where(groups.rising, groups.high, groups.low)
    upper, lower, dots = (kinds == kind for kind in (UPPER, LOWER, DOTS))
    first[:, upper] = second[:, upper] = groups.high[:, upper]
    first[:, lower] = second[:, lower] = groups.low[:, lower]
    second[:, dots] = np.where(groups.low[:, dots] == groups.high[:, dots], np.nan, second[:, dots])
    return times, np.stack((first, second), axis=1).reshape(-1, first.shape[1])


def _some(column: np.ndarray) -> float:
    finite = column[np.isfinite(column)]
    return float(finite[0]) if finite.size else np.nan


def _instant(origin: int, seconds: float) -> int:
    return origin + math.floor(seconds * 1e9)
