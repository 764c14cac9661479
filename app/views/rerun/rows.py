"""Rows of the track as Rerun's entities: for the page's live view and for recordings."""

from __future__ import annotations

import numpy as np
import rerun as rr

from estimators.diagnostics.detector_state import SENSOR_STATES, sensor_states_over_time
from estimators.diagnostics.field_pictures import Picture
from estimators.log import READING, Events, truth_of
from estimators.track import FAILED, GATED, HEALTH_NAMES, Track, estimated_rows

from ...live.interface import Running
from ...live.notices import Notice
from ...live.outputs import Pull
from ...present.drawing.colors import EITHER, Palette
from ...present.drawing.direct_readings import observed
from .layout import LANES, blueprint, styles
from .pictures import FieldDrawing, PairDrawing
from .sink import EVENTS, Sink, last_of_each_time, pair_name, send_blueprint, state_colors

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
        self,
        stream: rr.RecordingStream,
        engine: Running,
        *,
        series: float | None,
        layout: bool = True,
        palette: Palette = EITHER,
    ) -> None:
        """Log layout and styles.

        Args:
            stream: Where to.
            engine: Whose rows these will be.
            series: Stretches of time into which a long history is cut, each drawn by its extremes; those of the
                charts' window are never cut finer than its `PIXELS`, which is what infinity gives. None draws all.
            layout: Whether to log the blueprint.
            palette: The colours; of a file, whose viewer is not known, those between light and dark.
        """
        self._palette = palette
        self.model = engine.model
        self.pairs = np.asarray(engine.pairs, int).reshape(-1, 2)
        self.sink = Sink(stream, window=float(engine.twin.config.view.window))
        self._series = series
        self._layout = layout
        self._dots = observed(self.model)
        self._tells_field = bool(self.model.grid is not None and engine.twin.tells_field)
        self._revisions = 0
        self._lines: list[Notice] = []
        self._begin("")

    def _begin(self, root: str) -> None:
        self.sink.root = root
        self._next = 0
        self._newest: int | None = None
        self._oldest: int | None = None
        self._health = -1
        self._drawn = np.zeros(0, np.int64)
        self._drawn_t = np.zeros(0, np.int64)
        styles(self.sink.stream, self.model, self.pairs, root, self._palette)
        self.sink.static(
            "/health",
            rr.StateConfiguration(
                values=list(HEALTH_NAMES), labels=list(HEALTH_NAMES), colors=state_colors(HEALTH_NAMES, self._palette)
            ),
        )
        self._sensors = list(self.model.sensor_names) if len(self.model.sensors) <= LANES else []
        self._states_of = dict.fromkeys(self._sensors, -1)
        for name in self._sensors:
            self.sink.static(
                f"/sensor/{name}",
                rr.StateConfiguration(
                    values=list(SENSOR_STATES),
                    labels=list(SENSOR_STATES),
                    colors=state_colors(SENSOR_STATES, self._palette),
                ),
            )
        if self._layout:
            layout = blueprint(self.model, self.pairs, window=self.sink.window, root=root, truth=self._tells_field)
            send_blueprint(self.sink.stream, layout)
        self._field: FieldDrawing | None = None
        if self.model.grid is not None:
            self._field = FieldDrawing(self.model, truth=self._tells_field, theme=self._palette)
            self._field.static(self.sink)
        self._ellipses = [
            PairDrawing(self.model, k, pair, f"/pair/{pair_name(self.model, pair)}/up", self._palette)
            for k, pair in enumerate(self.pairs)
        ]

    def __call__(self, pull: Pull) -> None:
        """Log one pull."""
        if pull.fresh:
            self._revisions += 1
            if self._revisions > 1:
                self._begin(f"/revision_{pull.revision}")
        t = pull.events.t
        if t.size:
            newest = self._newest
            rewritten = newest is not None and pull.first < self._next
            after = t > newest if rewritten else np.ones(t.size, bool)
            fresh = self._not_drawn(pull.events) if rewritten else after
            self._next = pull.first + t.size
            self.rows(pull.events, pull.track, lines=after, dots=fresh)
        self.pictures(pull.pictures)
        self.notices(pull.notices)

    def begin(self, pull: Pull) -> None:
        """Take note of a whole revision whose rows will be logged in pieces, by `rows`."""
        self._revisions += 1
        self._next = pull.first + len(pull.events)
        self._oldest = int(pull.events.t[0])
        self.sink.started(self._oldest)

    def width(self, t: np.ndarray) -> int:
        """Nanoseconds of the stretches into which rows at times `t` are cut for drawing."""
        if self._series is None or not t.size:
            return 0
        return int(max(self.sink.window * 1e9 / PIXELS, (int(t[-1]) - int(t[0])) / self._series))

    def rows(
        self,
        events: Events,
        track: Track,
        *,
        lines: np.ndarray | None = None,
        dots: np.ndarray | None = None,
        past: bool = False,
    ) -> None:
        """Log rows.

        Args:
            events: The events.
            track: Their rows.
            lines: Mask of the rows to draw as lines; None for all.
            dots: Mask of the rows to draw as dots.
            past: These rows came before rows that are drawn already.
        """
        t = events.t
        self.sink.started(int(t[0]))
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
            self._sensor_changes(events.select(lines), line_track, past)
            for ellipse in self._ellipses:
                ellipse.draw(self.sink, line_t, line_track, events.select(lines), past)
        if dots.any():
            drawn = events.select(dots)
            self._readings(drawn, track.select(dots), width)
            self._remember(drawn)

    def pictures(self, pictures: list[Picture], *, past: bool = False) -> None:
        """Log the pictures of a large field; `past` as in `rows`."""
        if self._field is not None:
            self._field.pictures(self.sink, pictures, current=not past)

    def previous(self, t: np.ndarray, track: Track) -> None:
        """Log another revision's rows as the thin grey lines behind this one's."""
        rows = last_of_each_time(t)
        width = self.width(t)
        known = estimated_rows(track)[rows]
        for j, name in enumerate(state.name for state in self.model.shown_states):
            mean = np.where(known, track.mean[rows, j], np.nan)
            self.sink.line(f"/previous/state/{name}", t[rows], mean[:, None], width, gaps=True)
        self.sink.line("/previous/nis", t[rows], track.nis_mean[rows, None], width, gaps=True)

    def notices(self, notices: list[Notice]) -> None:
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
        self.sink.stream.send_columns(
            EVENTS,
            indexes=[self.sink.times(times.astype(np.int64))],
            columns=rr.TextLog.columns(text=[line.text for line in due], level=[line.level.upper() for line in due]),
        )

    def smoothed(self, t: np.ndarray, track: Track) -> None:
        """Log a smoothed track's states, a line and a band of their own beside the filter's."""
        self._states(t, track, self.width(t), "/smoothed")

    def _states(self, t: np.ndarray, track: Track, width: int, above: str = "") -> None:
        rows = last_of_each_time(t)
        known = estimated_rows(track)[rows]
        for j, name in enumerate(state.name for state in self.model.shown_states):
            # A probability has no band.
            mean, twice = track.mean[rows, j], 2.0 * track.std[rows, j] * (j != self.model.mode)
            band = np.where(known[:, None], np.stack((mean, mean + twice, mean - twice), axis=1), np.nan)
            self.sink.line(f"{above}/state/{name}", t[rows], band, width, gaps=True)

    def _window_nis(self, t: np.ndarray, track: Track, width: int) -> None:
        rows = last_of_each_time(t)
        columns = (track.nis_mean[rows], track.nis_low[rows], track.nis_high[rows])
        self.sink.line("/nis/window", t[rows], np.stack(columns, axis=1), width, by_first=True, gaps=True)

    def _health_changes(self, t: np.ndarray, track: Track, past: bool) -> None:
        health = track.health
        before = -1 if past else self._health
        changes = np.flatnonzero(np.append(before, health[:-1]) != health)
        if not past:
            self._health = int(health[-1])
        if changes.size:
            names = [HEALTH_NAMES[health[k]] for k in changes]
            self.sink.columns("/health", t[changes], rr.StateChange.columns(state=names))

    def _sensor_changes(self, events: Events, track: Track, past: bool) -> None:
        for s, name in enumerate(self._sensors):
            rows, states = sensor_states_over_time(events, track, s)
            if not rows.size:
                continue
            changes = np.flatnonzero(np.append(-1 if past else self._states_of[name], states[:-1]) != states)
            if not past:
                self._states_of[name] = int(states[-1])
            if changes.size:
                words = [SENSOR_STATES[states[k]] for k in changes]
                self.sink.columns(f"/sensor/{name}", events.t[rows[changes]], rr.StateChange.columns(state=words))

    def _readings(self, events: Events, track: Track, width: int) -> None:
        channel, t = events.channel, events.t
        is_reading = events.kind == READING
        for j, state in zip(self.model.shown.tolist(), self.model.shown_states, strict=True):
            rows, values = truth_of(events, j)
            self.sink.line(f"/truth/{state.name}", t[rows], values[:, None], width)
        for item in self._dots:
            name = self.model.row_names[self.model.row_start[item.sensor] + item.row]
            of_sensor = is_reading & (channel == item.sensor)
            gated, screened = track.verdict == GATED, track.screened[:, item.row] != 0
            for path, mask in (("reading", ~gated & ~screened), ("refused", gated & ~screened), ("screened", screened)):
                rows = of_sensor & mask
                self.sink.line(f"/{path}/{name}", t[rows], events.value[rows, item.row, None], width)
        if self._field is not None:
            self._field.readings(self.sink, events, track, width)
            self._field.note(events, track)
        for k, sensor in enumerate(() if self._field is not None else self.model.sensors):
            mask = is_reading & (channel == k)
            if not mask.any():
                continue
            for r in range(len(sensor.rows)):
                nu, twice = track.innovation[mask, r], 2.0 * track.innovation_std[mask, r]
                path = f"/innovation/{self.model.row_names[self.model.row_start[k] + r]}"
                failed = track.verdict[mask] == FAILED
                self.sink.line(path, t[mask], np.stack((nu, twice, -twice), axis=1), width, by_first=True, gaps=failed)
        self.sink.line("/nis/reading", t[is_reading], track.nis[is_reading, None], width)

    def _keys(self, events: Events) -> np.ndarray:
        # One number an event; that int64 wraps around does not matter.
        return events.t * 4096 + events.channel * 8 + events.kind

    def _remember(self, events: Events) -> None:
        assert self._newest is not None
        t = np.concatenate((self._drawn_t, events.t))
        recent = t >= self._newest - REMEMBERED
        self._drawn = np.concatenate((self._drawn, self._keys(events)))[recent]
        self._drawn_t = t[recent]

    def _not_drawn(self, events: Events) -> np.ndarray:
        return ~np.isin(self._keys(events), self._drawn)
