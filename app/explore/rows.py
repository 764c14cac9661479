"""Rows of the track as Rerun entities, for the page's live view and for recordings."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import rerun as rr

from estimators.diagnostics.detector_state import SENSOR_STATES, sensor_states_over_time
from estimators.diagnostics.field_pictures import Picture
from estimators.diagnostics.references import shown_track
from estimators.log import READING, Events
from estimators.track import FAILED, HEALTH_NAMES, Track

from ..charts.colors import EITHER, Palette
from ..charts.direct_readings import measured_by
from ..columns import Rows, columns_of, rows_of
from ..engine.copies import Pull
from ..engine.notices import Notice
from ..engine.running_fold import Running
from .layout import MAX_SENSOR_LANES, blueprint, styles
from .pictures import FieldDrawing, PairDrawing
from .sink import NOTICES_PATH, Sink, last_of_each_time, pair_name, send_blueprint, state_colors

WINDOW_STRETCHES = 1200  # Stretches into which the charts' window is cut; each is drawn by its extremes
LATE_MEMORY_NS = 30 * 10**9  # Age up to which a late measurement is recognised as already drawn


class RerunRows:
    """Logs pulls of one engine into one stream.

    Rerun cannot take back rows. So a revision that follows another in the same stream gets paths and a blueprint of its
    own. Of rows that a late measurement rewrote, only new dots are drawn; the lines keep the earlier estimate.
    """

    def __init__(
        self,
        stream: rr.RecordingStream,
        engine: Running | SimpleNamespace,
        *,
        series: float | None,
        layout: bool = True,
        palette: Palette = EITHER,
    ) -> None:
        """Log layout and styles.

        Args:
            stream: Where to.
            engine: Source of the rows.
            series: Stretches of time into which a long history is cut, each drawn by its extremes. Those in the charts'
                window are never cut finer than `WINDOW_STRETCHES`, which infinity gives. None draws every row.
            layout: Whether to log the blueprint.
            palette: Colours; a file, whose viewer is unknown, has those between light and dark.
        """
        self._palette = palette
        self.model = engine.model
        self.pairs = np.asarray(engine.pairs, int).reshape(-1, 2)
        self.sink = Sink(stream, window=float(engine.twin.config.view.window))
        self._series = series
        self._layout = layout
        self._columns = columns_of(self.model)
        self._dots = [row for rows in measured_by(self.model).values() for row in rows]
        self._has_field_truth = bool(self.model.grid is not None and engine.twin.tells_field)
        self._revisions = 0
        self._waiting: list[Notice] = []
        self._begin("")

    def _begin(self, root: str) -> None:
        """Start another revision below its own root."""
        self.sink.root = root
        self._next = 0
        self._newest: int | None = None
        self._oldest: int | None = None
        self._drawn = np.zeros(0, np.int64)
        self._drawn_t = np.zeros(0, np.int64)
        styles(self.sink.stream, self.model, self.pairs, root, self._palette)
        sensors = self.model.sensor_names if len(self.model.sensors) <= MAX_SENSOR_LANES else ()
        self._states = {"/health": -1} | {f"/sensor/{name}": -1 for name in sensors}
        for path in self._states:
            words = list(HEALTH_NAMES if path == "/health" else SENSOR_STATES)
            colors = state_colors(words, self._palette)
            self.sink.static(path, rr.StateConfiguration(values=words, labels=words, colors=colors))
        if self._layout:
            layout = blueprint(self.model, self.pairs, window=self.sink.window, root=root, truth=self._has_field_truth)
            send_blueprint(self.sink.stream, layout)
        self._field: FieldDrawing | None = None
        if self.model.grid is not None:
            self._field = FieldDrawing(self.model, truth=self._has_field_truth, theme=self._palette)
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
            after = new = np.ones(t.size, bool)
            if self._newest is not None and pull.first < self._next:
                after, new = t > self._newest, ~np.isin(_keys(pull.events), self._drawn)
            self._next = pull.first + t.size
            self.rows(pull.events, pull.track, lines=after, dots=new)
        self.pictures(pull.pictures)
        self.notices(pull.notices)

    def begin(self, pull: Pull) -> None:
        """Prepare for a whole revision, whose rows are logged in pieces by `rows`."""
        self._revisions += 1
        self._next = pull.first + len(pull.events)
        self._oldest = int(pull.events.t[0])
        self.sink.started(self._oldest)

    def width(self, t: np.ndarray) -> int:
        """Return the length (ns) of the stretches into which rows at times `t` are cut for drawing."""
        if self._series is None or not t.size:
            return 0
        return int(max(self.sink.window * 1e9 / WINDOW_STRETCHES, (int(t[-1]) - int(t[0])) / self._series))

    def rows(
        self,
        events: Events,
        track: Track,
        *,
        lines: np.ndarray | None = None,
        dots: np.ndarray | None = None,
        past: bool = False,
    ) -> None:
        """Log events and their rows.

        `lines` and `dots` are masks of the rows that these are drawn of, None for all; `past` tells whether these rows
        precede rows that are already drawn.
        """
        t = events.t
        self.sink.started(int(t[0]))
        self._oldest = int(t[0]) if self._oldest is None else min(int(t[0]), self._oldest)
        self._newest = int(t[-1]) if self._newest is None else max(int(t[-1]), self._newest)
        width = self.width(t)
        if lines is None or lines.any():
            drawn, part = (events, track) if lines is None else (events.select(lines), track.select(lines))
            self._draw_lines(drawn.t, part, width, drawn)
            self._draw_states(drawn, part, past)
            for ellipse in self._ellipses:
                ellipse.draw(self.sink, drawn.t, shown_track(self.model, part), drawn, past)
        if dots is None or dots.any():
            drawn, part = (events, track) if dots is None else (events.select(dots), track.select(dots))
            self._draw_dots(drawn, part, width)
            times = np.concatenate((self._drawn_t, drawn.t))
            recent = times >= self._newest - LATE_MEMORY_NS
            self._drawn, self._drawn_t = np.concatenate((self._drawn, _keys(drawn)))[recent], times[recent]

    def pictures(self, pictures: list[Picture], *, past: bool = False) -> None:
        """Log the pictures of a large field; `past` as in `rows`."""
        if self._field is not None:
            self._field.pictures(self.sink, pictures, current=not past)

    def previous(self, t: np.ndarray, track: Track) -> None:
        """Log the rows of another revision as thin grey lines."""
        self._draw_lines(t, track, self.width(t), above="/previous", kinds=("mean",), nis="/previous/nis")

    def smoothed(self, t: np.ndarray, track: Track) -> None:
        """Log the states of a smoothed track, a line and a band beside the filter's."""
        self._draw_lines(t, track, self.width(t), above="/smoothed", nis="")

    def notices(self, notices: list[Notice]) -> None:
        """Log notices once the rows have reached their time: a viewer that follows shows the newest time of all.

        They have one path in all revisions, so that the table of a recording lists all of them.
        """
        self._waiting += notices
        if self._newest is None or self._oldest is None:
            return
        due = [line for line in self._waiting if line.t <= self._newest]
        self._waiting = [line for line in self._waiting if line.t > self._newest]
        if not due:
            return
        times = np.maximum([line.t for line in due], self._oldest)
        self.sink.stream.send_columns(
            NOTICES_PATH,
            indexes=[self.sink.times(times.astype(np.int64))],
            columns=rr.TextLog.columns(text=[line.text for line in due], level=[line.level.upper() for line in due]),
        )

    def _values(self, rows: Rows, names: list[str]) -> np.ndarray:
        """Return columns of the charts, (n, names)."""
        return np.stack([self._columns[name].of(rows) for name in names], axis=1)

    def _draw_lines(
        self,
        t: np.ndarray,
        track: Track,
        width: int,
        events: Events | None = None,
        *,
        above: str = "",
        kinds: tuple[str, ...] = ("mean", "upper", "lower"),
        nis: str = "/nis/window",
    ) -> None:
        """Log the states with their bands, and the windowed NIS with its bounds, of the last row of each time."""
        last = last_of_each_time(t)
        rows = Rows(Events.empty(self.model.width) if events is None else events.select(last), track.select(last))
        for state in self.model.shown_states:
            values = self._values(rows, [f"{kind}:{state.name}" for kind in kinds])
            self.sink.line(f"{above}/state/{state.name}", t[last], values, width, gaps=True)
        if nis:
            columns = ["nis_mean", "nis_low", "nis_high"][: len(kinds)]
            self.sink.line(nis, t[last], self._values(rows, columns), width, by_first=True, gaps=True)

    def _draw_states(self, events: Events, track: Track, past: bool) -> None:
        """Log the changes of the health, and of each sensor's state."""
        for path, before in self._states.items():
            if path == "/health":
                rows, states, words = np.arange(len(events)), track.health, HEALTH_NAMES
            else:
                sensor = self.model.sensor_names.index(path.removeprefix("/sensor/"))
                (rows, states), words = sensor_states_over_time(events, track, sensor), SENSOR_STATES
            if not rows.size:
                continue
            changes = np.flatnonzero(np.append(-1 if past else before, states[:-1]) != states)
            if not past:
                self._states[path] = int(states[-1])
            if changes.size:
                named = [words[states[k]] for k in changes]
                self.sink.columns(path, events.t[rows[changes]], rr.StateChange.columns(state=named))

    def _draw_dots(self, events: Events, track: Track, width: int) -> None:
        """Log truth, measurements, innovations with their expected band, and the NIS of each measurement."""
        t, rows = events.t, Rows(events, track)
        for state in self.model.shown_states:
            self.sink.line(f"/truth/{state.name}", t, self._values(rows, [f"truth:{state.name}"]), width)
        for name in self._dots:
            used, held = (self._columns[f"{kind}:{name}"].of(rows) for kind in ("reading", "held"))
            self.sink.line(f"/reading/{name}", t, np.where(np.isfinite(used), used, held)[:, None], width)
            for kind in ("refused", "screened"):
                self.sink.line(f"/{kind}/{name}", t, self._values(rows, [f"{kind}:{name}"]), width)
        if self._field is not None:
            self._field.readings(self.sink, events, track, width)
            self._field.note(events, track)
        else:
            for name, sensor, _ in rows_of(self.model):
                mine = rows.of_sensor(sensor)
                if mine.any():
                    columns = [f"{kind}:{name}" for kind in ("innovation", "innovation_upper", "innovation_lower")]
                    values, failed = self._values(rows, columns)[mine], track.verdict[mine] == FAILED
                    self.sink.line(f"/innovation/{name}", t[mine], values, width, by_first=True, gaps=failed)
        measured = events.kind == READING
        self.sink.line("/nis/reading", t[measured], track.nis[measured, None], width)


def _keys(events: Events) -> np.ndarray:
    """Return one number per event, which identifies it; int64 may wrap around."""
    return events.t * 4096 + events.channel * 8 + events.kind
