"""The charts: each state with its filled 2σ band and what is known of it, and the NIS with its bounds."""

from __future__ import annotations

from typing import Any

import numpy as np
import viser

from estimators.log import BEFORE, READING, truth_of
from estimators.model.state_space import StateSpaceModel
from estimators.track import GATED

from ..drawing.direct_readings import observed
from ..engine.counts import estimated_rows
from ..engine.outputs import Pull
from .decimate import Buckets, bridge, extended, runs
from .history import History
from .series import BLUE, DOTS, GREEN, GREY, HEIGHT, RED, axes, frame, nis_series, no_data, send, state_series
from .time_units import unit_for, window_name

WINDOWS = (10.0, 30.0, 60.0, 300.0)
"""Seconds that the charts can show, beside the twin's own window and everything."""

BUCKETS = 300
RUNS = 6
"""Stretches without a gap in which a line is drawn at most."""

MARKS = 5
"""Series of dots in a state's chart: readings of up to three sensors, those that the gate refused, and the edge."""

SHOWN = 6
"""States that have a chart of their own; of more, the last chart shows the one chosen."""


class Range:
    """The values that an axis spans: grows at once, shrinks only when much of it is empty, so it does not twitch."""

    def __init__(self) -> None:
        self._low, self._high = np.nan, np.nan

    def series(self, columns: list[np.ndarray]) -> np.ndarray:
        """A series as long as the columns that holds the two ends of their range."""
        values = np.concatenate(columns)
        values = values[np.isfinite(values)]
        if values.size:
            low, high = float(values.min()), float(values.max())
            roomy = (high - low) < 0.5 * (self._high - self._low)
            if not (self._low <= low and high <= self._high) or roomy:
                margin = 0.08 * (high - low) or max(1e-9, 1e-3 * abs(high))
                self._low, self._high = low - margin, high + margin
        out = np.full(columns[0].size, self._low if np.isfinite(self._low) else 0.0)
        out[1::2] = self._high if np.isfinite(self._high) else 1.0
        return out


class Charts:
    """The chart handles, and the decimated columns that they show."""

    def __init__(self, server: viser.ViserServer, model: StateSpaceModel, window: float) -> None:
        self.model = model
        dots = observed(model)
        self.direct = [[(dot.sensor, dot.row) for dot in dots if dot.state == j] for j in model.shown]
        self.window: float | None = window
        self._previous: tuple[np.ndarray, np.ndarray] | None = None
        nx = len(model.shown)
        self._dot_columns = [[4 * nx + j * MARKS + d for d in range(min(3, len(self.direct[j])))] for j in range(nx)]
        self._nis = (4 + MARKS) * nx
        self._columns = self._nis + 4
        self._buckets = Buckets(self._columns, 1)
        self._shown = list(range(min(nx, SHOWN)))
        self._ranges = [Range() for _ in range(nx + 1)]
        self.unit = unit_for(window)
        self.windows: dict[str, float | None] = {window_name(value): value for value in sorted({window, *WINDOWS})}
        self.windows["all"] = None
        gui = server.gui
        self.window_choice = gui.add_dropdown("Window", tuple(self.windows), initial_value=window_name(window))
        self.key = gui.add_html(self._key())
        self._charts = [self._state_chart(gui, j) for j in self._shown[: SHOWN - 1]]
        self.state_choice = None
        if nx > SHOWN:
            rest = tuple(state.name for state in model.shown_states[SHOWN - 1 :])
            self.state_choice = gui.add_dropdown("State", rest, initial_value=rest[0])
        if nx >= SHOWN:
            self._charts.append(self._state_chart(gui, SHOWN - 1))
        self._nis_chart = self._make_nis_chart(gui)
        self.set_window(window)

    def set_window(self, window: float | None) -> None:
        """Show the last `window` seconds, or everything; the caller pulls the history again."""
        self.window = window
        self._buckets = Buckets(self._columns, int(1e9 * window / BUCKETS) if window else 1)

    def choose_state(self, name: str) -> None:
        """Show another state in the last chart."""
        self._shown[-1] = [state.name for state in self.model.shown_states].index(name)
        chart, state = self._charts[-1], self.model.shown_states[self._shown[-1]]
        chart.title = _title(self.model.label(state.name), state.unit)

    def set_previous(self, pull: Pull | None) -> None:
        """The track of the previous revision, drawn as a thin grey line."""
        if pull is None:
            self._previous = None
        else:
            self._previous = (
                pull.events.t.copy(),
                np.where(estimated_rows(pull.track)[:, None], pull.track.mean, np.nan),
            )

    def clear(self) -> None:
        """Forget all rows: another revision begins."""
        self._buckets = Buckets(self._columns, self._buckets.width)

    def update(self, history: History, changed: int) -> None:
        """Bring the decimated columns up to date with the history, of which the rows from `changed` on are new."""
        t = history.column("t")
        if not t.size:
            return
        buckets = self._buckets
        if self.window is None:
            # Everything: buckets double in width when the history has outgrown them.
            oldest = min(int(t[0]), int(buckets.first[0])) if buckets.first.size else int(t[0])
            while int(t[-1]) - oldest > buckets.width * 2 * BUCKETS:
                buckets.coarsen()
        else:
            buckets.forget(int(t[-1] - self.window * 1e9))
        buckets.update(t, changed, lambda start, end: self._values(history, start, end))

    def draw(self, history: History) -> None:
        """Send what the charts show now."""
        t = history.column("t")
        if not t.size or history.origin is None:
            return
        since = BEFORE if self.window is None else int(t[-1] - self.window * 1e9)
        times, values = self._buckets.points(since)
        x = self._in_unit(times, history.origin)
        if x.size == 1:
            x, times, values = np.repeat(x, 2), np.repeat(times, 2), np.repeat(values, 2, axis=0)
        for chart, j in zip(self._charts, self._shown, strict=True):
            send(chart, *self._state_data(x, times, values, j))
        send(self._nis_chart, *self._nis_data(x, values))

    def _in_unit(self, times: np.ndarray, origin: int) -> np.ndarray:
        """Times as the axes have them, in the unit that suits what is shown."""
        span = self.window if self.window is not None else float(times[-1] - times[0]) * 1e-9
        unit = unit_for(span, self.unit)
        if unit != self.unit:
            self.unit = unit
            for chart in (*self._charts, self._nis_chart):
                chart.axes = axes(unit)
        return (times - origin) * (1e-9 / unit.seconds)

    def _values(self, history: History, start: int, end: int) -> np.ndarray:
        nx = len(self.model.shown)
        rows = slice(start, end)
        mean, std = history.column("mean")[rows], history.column("std")[rows]
        events, verdict = history.events(rows), history.column("verdict")[rows]
        out = np.full((end - start, self._columns), np.nan)
        out[:, :nx] = mean
        out[:, nx : 2 * nx] = mean + 2 * std
        out[:, 2 * nx : 3 * nx] = mean - 2 * std
        if self.model.mode >= 0:
            # A probability has no band: the standard deviation of what is 0 or 1 says nothing more.
            out[:, nx + self.model.mode] = out[:, 2 * nx + self.model.mode] = mean[:, self.model.mode]
        reading, gated, screened = events.kind == READING, verdict == GATED, history.column("screened")[rows]
        for j in range(nx):
            true, values = truth_of(events, int(self.model.shown[j]))
            out[true, 3 * nx + j] = values
            for column, (sensor, row) in zip(self._dot_columns[j], self.direct[j], strict=False):
                mine = reading & (events.channel == sensor)
                refused = screened[:, row] != 0
                out[:, column] = np.where(mine & ~gated & ~refused, events.value[:, row], np.nan)
                for mark, which in ((3, mine & gated & ~refused), (4, mine & refused)):
                    at = np.flatnonzero(which)
                    out[at, 4 * nx + j * MARKS + mark] = events.value[at, row]
        for k, name in enumerate(("nis", "nis_mean", "nis_low", "nis_high")):
            out[:, self._nis + k] = history.column(name)[rows]
        return out

    def _state_data(
        self, x: np.ndarray, times: np.ndarray, values: np.ndarray, j: int
    ) -> tuple[list[np.ndarray], tuple[dict[str, Any], ...]]:
        """Columns of one state's chart, and the series that they are."""
        nx = len(self.model.shown)
        previous = np.full(x.size, np.nan)
        if self._previous is not None and self._previous[0].size:
            t, mean = self._previous
            previous = np.interp(times, t, mean[:, j], left=np.nan, right=np.nan)
        dots = [values[:, 4 * nx + j * MARKS + d] for d in range(MARKS)]
        mean, high, low = (values[:, k * nx + j] for k in range(3))
        # One state that is not a number leaves no estimate, whatever the others say.
        known = np.isfinite(values[:, : 3 * nx]).all(axis=1)
        mean = np.where(known, mean, np.nan)
        means, before = runs(mean, known, RUNS), runs(previous, np.isfinite(previous), RUNS)
        # Where the estimate is not a number, the band has no width, so it is not seen.
        band = [np.where(known, edge, extended(mean)) for edge in (high, low)]
        columns = [*band, *dots[:3], *before, bridge(values[:, 3 * nx + j]), *means, *dots[3:]]
        return [x, *columns, self._ranges[j].series(columns)], state_series(len(before), len(means))

    def _nis_data(self, x: np.ndarray, values: np.ndarray) -> tuple[list[np.ndarray], tuple[dict[str, Any], ...]]:
        """Columns of the NIS chart, and the series that they are."""
        nis, mean, low, high = (values[:, self._nis + k] for k in range(4))
        bound = np.nanmax(high) if np.isfinite(high).any() else np.nan
        if np.isfinite(bound):
            # One outlier must not flatten the rest: what lies far above the bound is drawn at the top.
            nis = np.minimum(nis, 4 * bound)
        known = np.isfinite(mean)
        band = [np.where(known, edge, extended(mean)) for edge in (high, low)]
        highs, lows, means = (runs(column, known, RUNS) for column in (high, low, mean))
        columns = [*band, *highs, *lows, *means, nis]
        return [x, *columns, self._ranges[-1].series([*columns, np.zeros(x.size)])], nis_series(len(means))

    def _state_chart(self, gui: viser.GuiApi, j: int) -> viser.GuiUplotHandle:
        state = self.model.shown_states[j]
        series = state_series(1, 1)
        return gui.add_uplot(
            no_data(len(series)),
            series,  # type: ignore[arg-type]
            title=_title(self.model.label(state.name), state.unit),
            bands=({"series": (1, 2), "fill": "rgba(37,99,235,0.16)"},),
            **frame(HEIGHT, self.unit),
        )

    def _make_nis_chart(self, gui: viser.GuiApi) -> viser.GuiUplotHandle:
        series = nis_series(1)
        return gui.add_uplot(
            no_data(len(series)),
            series,  # type: ignore[arg-type]
            title="NIS: mean of the last readings in its 95 % bounds",
            bands=({"series": (1, 2), "fill": "rgba(22,163,74,0.10)"},),
            **frame(HEIGHT, self.unit),
        )

    def _key(self) -> str:
        def mark(color: str, text: str) -> str:
            return (
                f'<span style="white-space:nowrap;margin-right:0.9em"><span style="color:{color}">{text}</span></span>'
            )

        parts = [
            mark(BLUE, "━ estimate"),
            mark("#93b4f5", "▮ ±2σ"),
            mark(DOTS[0], "● reading"),
            mark(RED, "● gated"),
            mark(RED, "○ screened"),
            mark(GREEN, "━ truth"),
            mark(GREY, "━ previous revision"),
        ]
        return f'<div style="font-size:0.75em;padding:0 0.8em 0.3em;font-weight:400">{"".join(parts)}</div>'


def _title(name: str, unit: str) -> str:
    return f"{name} [{unit}]" if unit and unit != "1" else name
