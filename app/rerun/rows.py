"""Rows of the track as Rerun's entities: for the page's live view and for recordings."""

from __future__ import annotations

from typing import Any

import numpy as np
import rerun as rr

from estimators.diagnostics.field_pictures import Picture
from estimators.log import READING, Readings, truth_of
from estimators.track import FAILED, GATED, HEALTH_NAMES, Track

from ..drawing.direct_readings import observed
from ..engine.counts import estimated_rows
from ..engine.interface import Running
from .field import FieldDrawing
from .layout import EVENTS, HEALTH_COLORS, TIMELINE, blueprint, pair_name, styles
from .pairs import PairDrawing
from .thin import last_of_each_time, thin

CALENDAR = 10**18
"""Nanoseconds from which on times are dates (this one is in 2001), and before which they are durations."""

PIXELS = 1200
"""Stretches into which the charts' window is cut; each is drawn by its extremes."""

REMEMBERED = 30 * 10**9
"""Nanoseconds back to which late readings are told from those drawn already."""


class RerunRows:
    """Logs pulls of one engine into one stream.

    Rows once logged cannot be taken back. So a revision that follows another in the same stream gets paths of its own
    (and a blueprint that shows them); and of rows that a late reading rewrote, only what is new is drawn: its dots,
    while the lines keep showing what was concluded without it.
    """

    def __init__(
        self, stream: rr.RecordingStream, engine: Running, *, series: float | None, layout: bool = True
    ) -> None:
        """Log layout and styles.

        Args:
            stream: Where to.
            engine: Whose rows these will be.
            series: Stretches of time into which a long history is cut, each drawn by its extremes; those of the
                charts' window are never cut finer than its `PIXELS`, which is what infinity gives. None draws all.
            layout: Whether to log the blueprint.
        """
        self.stream = stream
        self.model = engine.model
        self.pairs = np.asarray(engine.pairs, int).reshape(-1, 2)
        self.window = float(engine.twin.config.view.window)
        self._series = series
        self._layout = layout
        self._dots = observed(self.model)
        self._tells_field = bool(self.model.grid is not None and engine.twin.tells_field)
        self._calendar: bool | None = None
        self._revisions = 0
        self._lines: list[Any] = []
        self._begin("")

    def _begin(self, root: str) -> None:
        self.root = root
        self._next = 0
        self._newest: int | None = None
        self._oldest: int | None = None
        self._health = -1
        self._drawn = np.zeros(0, np.int64)
        self._drawn_t = np.zeros(0, np.int64)
        styles(self.stream, self.model, self.pairs, root)
        self.stream.log(
            f"{root}/health",
            rr.StateConfiguration(
                values=list(HEALTH_NAMES), labels=list(HEALTH_NAMES), colors=np.array(HEALTH_COLORS, np.uint32)
            ),
            static=True,
        )
        if self._layout:
            layout = blueprint(self.model, self.pairs, window=self.window, root=root, truth=self._tells_field)
            self.stream.send_blueprint(layout)
        self._field = FieldDrawing(self.model, truth=self._tells_field) if self.model.grid is not None else None
        if self._field is not None:
            self._field.static(self)
        self._ellipses = [
            PairDrawing(self.model, k, pair, f"{root}/pair/{pair_name(self.model, pair)}/up")
            for k, pair in enumerate(self.pairs)
        ]

    def __call__(self, pull: Any) -> None:
        """Log one pull."""
        if pull.fresh:
            self._revisions += 1
            if self._revisions > 1:
                self._begin(f"/revision_{pull.revision}")
        t = pull.readings.t
        if t.size:
            newest = self._newest
            rewritten = newest is not None and pull.first < self._next
            after = t > newest if rewritten else np.ones(t.size, bool)
            fresh = self._not_drawn(pull.readings) if rewritten else after
            self._next = pull.first + t.size
            self.rows(pull.readings, pull.track, lines=after, dots=fresh)
        self.pictures(pull.pictures)
        self.notices(pull.notices)

    def begin(self, pull: Any) -> None:
        """Take note of a whole revision whose rows will be logged in pieces, by `rows`."""
        self._revisions += 1
        self._next = pull.first + len(pull.readings)
        self._calendar = bool(pull.readings.t[0] >= CALENDAR)
        self._oldest = int(pull.readings.t[0])

    def width(self, t: np.ndarray) -> int:
        """Nanoseconds of the stretches into which rows at times `t` are cut for drawing."""
        if self._series is None or not t.size:
            return 0
        return int(max(self.window * 1e9 / PIXELS, (int(t[-1]) - int(t[0])) / self._series))

    def rows(
        self,
        readings: Readings,
        track: Track,
        *,
        lines: np.ndarray | None = None,
        dots: np.ndarray | None = None,
        past: bool = False,
    ) -> None:
        """Log rows.

        Args:
            readings: The events.
            track: Their rows.
            lines: Mask of the rows to draw as lines; None for all.
            dots: Mask of the rows to draw as dots.
            past: These rows came before rows that are drawn already.
        """
        t = readings.t
        if self._calendar is None:
            self._calendar = bool(t[0] >= CALENDAR)
        self._oldest = int(t[0]) if self._oldest is None else min(int(t[0]), self._oldest)
        self._newest = int(t[-1]) if self._newest is None else max(int(t[-1]), self._newest)
        every = np.ones(t.size, bool)
        lines = every if lines is None else lines
        dots = every if dots is None else dots
        width = self.width(t)
        if lines.any():
            line_track, line_t = track.select(lines), t[lines]
            self._states(line_t, line_track, width)
            self._window_nis(line_t, line_track, width)
            self._health_changes(line_t, line_track, past)
            for ellipse in self._ellipses:
                ellipse.draw(self, line_t, line_track, readings.select(lines), past)
        if dots.any():
            drawn = readings.select(dots)
            self._readings(drawn, track.select(dots), width)
            self._remember(drawn)

    def pictures(self, pictures: list[Picture], *, past: bool = False) -> None:
        """Log the pictures of a large field; `past` as in `rows`."""
        if self._field is not None:
            self._field.pictures(self, pictures, current=not past)

    def previous(self, t: np.ndarray, track: Track) -> None:
        """Log another revision's rows as the thin grey lines behind this one's."""
        rows = last_of_each_time(t)
        width = self.width(t)
        known = estimated_rows(track)[rows]
        for j, name in enumerate(state.name for state in self.model.shown_states):
            mean = np.where(known, track.mean[rows, j], np.nan)
            self._line(f"/previous/state/{name}", t[rows], mean[:, None], width, gaps=True)
        self._line("/previous/nis", t[rows], track.nis_mean[rows, None], width, gaps=True)

    def notices(self, notices: list[Any]) -> None:
        """Log lines for people, once the rows have come to their time: a viewer that follows goes to the last of all.

        They are under one path in all revisions, so that the table of a recording has them all.
        """
        self._lines += notices
        if self._newest is None or self._oldest is None:
            return
        due = [line for line in self._lines if line.t <= self._newest]
        self._lines = [line for line in self._lines if line.t > self._newest]
        if not due:
            return
        times = np.maximum([line.t for line in due], self._oldest)
        self.stream.send_columns(
            EVENTS,
            indexes=[self.times(times.astype(np.int64))],
            columns=rr.TextLog.columns(text=[line.text for line in due], level=[line.level.upper() for line in due]),
        )

    def times(self, t: np.ndarray) -> rr.TimeColumn:
        """Times as a column of the timeline."""
        if self._calendar:
            return rr.TimeColumn(TIMELINE, timestamp=t.astype("datetime64[ns]"))
        return rr.TimeColumn(TIMELINE, duration=t.astype("timedelta64[ns]"))

    def _states(self, t: np.ndarray, track: Track, width: int) -> None:
        rows = last_of_each_time(t)
        known = estimated_rows(track)[rows]
        for j, name in enumerate(state.name for state in self.model.shown_states):
            # A probability has no band.
            mean, twice = track.mean[rows, j], 2.0 * track.std[rows, j] * (j != self.model.mode)
            band = np.where(known[:, None], np.stack((mean, mean + twice, mean - twice), axis=1), np.nan)
            self._line(f"/state/{name}", t[rows], band, width, gaps=True)

    def _window_nis(self, t: np.ndarray, track: Track, width: int) -> None:
        rows = last_of_each_time(t)
        columns = (track.nis_mean[rows], track.nis_low[rows], track.nis_high[rows])
        self._line("/nis/window", t[rows], np.stack(columns, axis=1), width, by_first=True, gaps=True)

    def _health_changes(self, t: np.ndarray, track: Track, past: bool) -> None:
        health = track.health
        before = -1 if past else self._health
        changes = np.flatnonzero(np.append(before, health[:-1]) != health)
        if not past:
            self._health = int(health[-1])
        if changes.size:
            self.stream.send_columns(
                f"{self.root}/health",
                indexes=[self.times(t[changes])],
                columns=rr.StateChange.columns(state=[HEALTH_NAMES[health[k]] for k in changes]),
            )

    def _readings(self, readings: Readings, track: Track, width: int) -> None:
        channel, t = readings.channel, readings.t
        is_reading = readings.kind == READING
        for j, state in zip(self.model.shown.tolist(), self.model.shown_states, strict=True):
            rows, values = truth_of(readings, j)
            self._line(f"/truth/{state.name}", t[rows], values[:, None], width)
        for item in self._dots:
            name = self.model.row_names[self.model.row_start[item.sensor] + item.row]
            of_sensor = is_reading & (channel == item.sensor)
            for path, mask in (("reading", track.verdict != GATED), ("refused", track.verdict == GATED)):
                rows = of_sensor & mask
                self._line(f"/{path}/{name}", t[rows], readings.value[rows, item.row, None], width)
        if self._field is not None:
            self._field.readings(self, readings, track, width)
            self._field.note(readings, track)
        for k, sensor in enumerate(() if self._field is not None else self.model.sensors):
            mask = is_reading & (channel == k)
            if not mask.any():
                continue
            for r in range(len(sensor.rows)):
                nu, twice = track.innovation[mask, r], 2.0 * track.innovation_std[mask, r]
                path = f"/innovation/{self.model.row_names[self.model.row_start[k] + r]}"
                failed = track.verdict[mask] == FAILED
                self._line(path, t[mask], np.stack((nu, twice, -twice), axis=1), width, by_first=True, gaps=failed)
        self._line("/nis/reading", t[is_reading], track.nis[is_reading, None], width)

    def log_static(self, path: str, what: Any) -> None:
        """Log what holds at every time."""
        self.stream.log(f"{self.root}{path}", what, static=True)

    def line(self, path: str, t: np.ndarray, values: np.ndarray, width: int, *, gaps: bool = False) -> None:
        """Log values (n, k) over time, thinned by the extremes of the first column; see `_line` for rows with NaN."""
        self._line(path, t, values, width, by_first=True, gaps=gaps)

    def gap(self, path: str, t: np.ndarray) -> None:
        """Log that under a path there is nothing from each of some times on, until something is logged."""
        if t.size:
            clear = rr.Clear.columns(is_recursive=np.zeros(t.size, bool))
            self.stream.send_columns(path, indexes=[self.times(t)], columns=clear)

    def _line(
        self,
        path: str,
        t: np.ndarray,
        values: np.ndarray,
        width: int,
        *,
        by_first: bool = False,
        gaps: bool | np.ndarray = False,
    ) -> None:
        """Log values (n, k) that are finite, thinned by their lowest and highest, or by those of the first column.

        Where they are not, the line leads on to the next; but where `gaps` says so, it ends, and begins anew behind.
        """
        good = np.isfinite(values).all(axis=1)
        ends = ~good & gaps
        self.gap(f"{self.root}{path}", t[ends & ~np.append(False, ends[:-1])])
        t, values = t[good], values[good]
        if not t.size:
            return
        key = values[:, :1] if by_first else values
        rows = thin(t, key.min(axis=1), key.max(axis=1), width)
        self.stream.send_columns(
            f"{self.root}{path}",
            indexes=[self.times(t[rows])],
            columns=rr.Scalars.columns(scalars=np.ascontiguousarray(values[rows])),
        )

    def _keys(self, readings: Readings) -> np.ndarray:
        # One number an event; that int64 wraps around does not matter.
        return readings.t * 4096 + readings.channel * 8 + readings.kind

    def _remember(self, readings: Readings) -> None:
        assert self._newest is not None
        t = np.concatenate((self._drawn_t, readings.t))
        recent = t >= self._newest - REMEMBERED
        self._drawn = np.concatenate((self._drawn, self._keys(readings)))[recent]
        self._drawn_t = t[recent]

    def _not_drawn(self, readings: Readings) -> np.ndarray:
        return ~np.isin(self._keys(readings), self._drawn)
