"""The panel of Viser's own window: how the estimate is, which estimator, Q and R, NIS. The page has all the rest."""

from __future__ import annotations

import html
import time
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import viser

from estimators.errors import ConfigError
from estimators.registry import ESTIMATORS, unfit
from estimators.track import DIVERGED, HEALTH_NAMES, TRACKING

from ...live.commands import SetEstimator, SetTuning
from ...live.interface import Running
from ...live.outputs import Status
from ...present.drawing.colors import LIGHT, RGB, Palette, round_step
from ...present.series.chart_stream import drawn
from ...present.series.columns import LINE, LOWER, UPPER
from ...present.series.levels_of_detail import FACTOR, grouped
from .coalescer import Coalescer
from .rows import ChoiceRow, NumberRow
from .scene import History
from .stage import Choice, Stage

REDRAWN = 0.5
"""Seconds between two redraws of the chart."""

WIDTH = 360
"""Of the panel, in pixels."""


class Panel:
    """Builds the panel once; `sync` brings it up to what the engine says."""

    def __init__(self, server: viser.ViserServer, engine: Running, coalescer: Coalescer, stage: Stage) -> None:
        self._engine, self._coalescer, self._stage = engine, coalescer, stage
        self._unit = unit_for(engine.twin.config.view.window)
        self._shown: dict[str, Any] = {}
        gui = self._gui = server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=stage.palette.estimate)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(WIDTH)
        self.status = gui.add_html("")
        self._note = gui.add_html("")
        status = engine.status()
        fitting = {name: entry.title for name, entry in ESTIMATORS.items() if unfit(entry, engine.model) is None}
        names = {title: name for name, title in fitting.items()}
        self._titles = fitting
        dropdown = gui.add_dropdown(
            "Estimator", tuple(names), initial_value=fitting[status.estimator], hint="Folds the history again"
        )
        self.estimator = ChoiceRow(dropdown, lambda title: engine.submit(SetEstimator(names[title])))
        self.nis = NisChart(gui, self._unit)
        self._drawn = -REDRAWN
        self.rows: dict[str, NumberRow] = {}
        configured = {item.key: item.value for item in engine.twin.tuning.items()}
        for prefix, title in {"Q": "Process noise Q", "R": "Sensor noise R"}.items():
            items = [item for item in status.tuning.items() if item.key.startswith(f"{prefix}.")]
            if not items:
                continue
            with gui.add_folder(title):
                for item in items:
                    self.rows[item.key] = NumberRow(
                        gui, coalescer, key=item.key, label=item.key.partition(".")[2], unit=item.unit,
                        value=item.value, configured=configured[item.key], complain=self.complain,
                        command=partial(SetTuning, item.key),
                    )  # fmt: skip
        self._scene = gui.add_folder("Scene")
        self.choices: dict[str, ChoiceRow] = {}
        self._offer()

    def complain(self, text: str) -> None:
        """Show one line about an edit that cannot be used, or nothing."""
        self._show(self._note, "note", note_html(text, self._stage.palette))

    def sync(self, history: History, origin: int | None) -> None:
        """Show what the engine says; whoever changed it, a browser, the API, or the engine itself."""
        status = self._engine.status()
        self.estimator.sync(self._titles.get(status.estimator, self.estimator.handle.value))
        for item in status.tuning.items():
            if item.key in self.rows:
                self.rows[item.key].sync(float(item.value))
        self._show(self.status, "status", status_html(status, origin, self._unit, self._stage.palette))
        self._offer()
        now = time.monotonic()
        state = (status.revision, history.base + history.n, origin)
        if origin is not None and now - self._drawn >= REDRAWN and self._shown.get("nis") != state:
            self._shown["nis"], self._drawn = state, now
            self.nis.draw(history, origin)

    def _offer(self) -> None:
        """The choices about the scene: those that there are now, and what is chosen."""
        offered = self._stage.choices.offered()
        if self._shown.get("choices") != offered:
            self._shown["choices"] = offered
            for row in self.choices.values():
                row.remove()
            with self._scene:
                self.choices = {item.key: self._choice(item) for item in offered}
            self._scene.visible = bool(offered)
        values = self._stage.choices.values()
        for key, row in self.choices.items():
            row.sync(values[key])

    def _choice(self, item: Choice) -> ChoiceRow:
        chosen = self._stage.choices.values()[item.key]
        handle = self._gui.add_dropdown(item.label, item.options, initial_value=chosen)
        return ChoiceRow(handle, partial(self._chosen, item.key))

    def _chosen(self, key: str, value: str) -> None:
        try:
            self._stage.choices.choose(key, value)
        except ConfigError as error:
            self.complain(str(error))
        else:
            self.complain("")

    def _show(self, handle: Any, key: str, content: str) -> None:
        if self._shown.get(key) != content:
            self._shown[key] = content
            handle.content = content


MANY = 3.0
"""So many of a unit at least are shown on an axis in that unit."""


@dataclass(frozen=True)
class Unit:
    """A unit of time, and with how many digits after the point it tells a moment."""

    name: str
    seconds: float
    digits: int

    def text(self, seconds: float) -> str:
        """A moment in this unit."""
        return f"{seconds / self.seconds:.{self.digits}f} {self.name}"


SECONDS = Unit("s", 1.0, 1)
UNITS = (SECONDS, Unit("min", 60.0, 2), Unit("h", 3600.0, 3), Unit("d", 86400.0, 4))


def unit_for(span: float) -> Unit:
    """The largest unit of which `span` seconds hold three; seconds if they hold none."""
    fitting = [unit for unit in UNITS if span >= MANY * unit.seconds]
    return fitting[-1] if fitting else SECONDS


COLUMNS = {"nis_high": UPPER, "nis_low": LOWER, "nis_mean": LINE}

GROUPS = 100
"""Groups of rows that are drawn at most, each as two points."""

HIGHEST = 4.0
"""Times the upper bound, up to which the mean is drawn."""


class NisChart:
    """The mean NIS of the last readings, between the bounds that a consistent filter keeps."""

    def __init__(self, gui: viser.GuiApi, unit: Unit) -> None:
        self._unit = unit
        none, line = "rgba(0,0,0,0)", {"spanGaps": True, "points": {"show": False}}
        axis = {"font": "11px sans-serif", "stroke": _css(LIGHT.previous), "ticks": {"size": 4}}
        below = {"size": 24, "label": f"time [{unit.name}]", "labelSize": 14, "labelFont": "11px sans-serif"}
        nothing = np.full(2, np.nan)
        self.handle = gui.add_uplot(
            (np.array([0.0, 1.0]), *(nothing for _ in COLUMNS), np.array([0.0, 1.0])),
            (
                {"label": "time"},
                {"label": "high", "stroke": none, "auto": False, **line},
                {"label": "low", "stroke": none, "auto": False, **line},
                {"label": "mean", "stroke": _css(LIGHT.estimate), "width": 1.5, "auto": False, **line},
                # uPlot finds no range of a series with NaN; this one is not seen and spans it for all.
                {"label": "range", "stroke": none, "width": 0, "points": {"show": False}},
            ),  # type: ignore[arg-type]
            title="NIS: mean of the last readings, 95 % bounds",
            bands=({"series": (1, 2), "fill": "rgba({},{},{},0.22)".format(*LIGHT.bound)},),
            scales={"x": {"time": False}},
            axes=(axis | below, axis | {"size": 44}),
            legend={"show": False},
            height=170,
            padding=(4, 14, 0, 0),
        )

    def draw(self, history: History, origin: int) -> None:
        """Send what the history holds, over time since `origin`, ns."""
        values = np.stack([history.column(name) for name in COLUMNS], axis=1)
        # Arrays of numbers have no gaps for uPlot: what was before one is left out, not joined by a line.
        gaps = np.flatnonzero(~np.isfinite(values[:, 2]))
        start = int(gaps[-1]) + 1 if gaps.size else 0
        rows, size = len(values) - start, 1
        if rows < 2:
            self.handle.data = (np.array([0.0, 1.0]), *(np.full(2, np.nan) for _ in COLUMNS), np.array([0.0, 1.0]))
            return
        while rows > GROUPS * size:
            size *= FACTOR
        groups = grouped(size, history.base + start, history.column("t")[start:], values[start:])
        times, points = drawn(groups, np.array(list(COLUMNS.values())))
        highest = float(points[:, 0].max())
        # A bad start must not flatten the rest: what lies far above the bounds is drawn at the top.
        top = round_step(1.2 * max(highest, min(HIGHEST * highest, float(points[:, 2].max()))))
        columns = np.minimum(points, top)
        ends = np.where(np.arange(times.size) % 2 == 0, 0.0, top)
        self.handle.data = ((times - origin) * (1e-9 / self._unit.seconds), *columns.T, ends)


def _css(color: RGB) -> str:
    return "rgb({},{},{})".format(*color)


SIGNS = {"waiting": "○", "tracking": "●", "suspect": "◐", "degraded": "▲", "diverged": "✖", "stale": "◌"}
"""The sign is there for whoever cannot tell the colours."""

STYLE = "padding:0.2em 1.4em 0.6em 0.9em;font-size:0.85em;line-height:1.6;overflow-wrap:anywhere"


def status_html(status: Status, origin: int | None, unit: Unit = SECONDS, palette: Palette = LIGHT) -> str:
    """Health, state and revision in one line, the cause and what to do below; times since `origin`, ns."""
    health = HEALTH_NAMES[status.health]
    since = ""
    if status.health != TRACKING and status.since is not None and origin is not None:
        since = f" since {unit.text((status.since - origin) * 1e-9)}"
    at = "" if status.t is None or origin is None else unit.text((status.t - origin) * 1e-9)
    state = "ended" if status.finished else "paused" if status.paused else ""
    fold = "folding again" if status.refolding else f"revision {status.revision}"
    if status.awaited is not None:
        fold = f"compiling {status.awaited}, {status.compiling.get(status.awaited) or 0.0:.0f} s"
    color = "rgb({},{},{})".format(*palette.health[health])
    return (
        f'<div style="{STYLE};font-variant-numeric:tabular-nums">'
        '<div style="display:flex;justify-content:space-between;gap:0.5em">'
        f'<b style="color:{color};white-space:nowrap">{SIGNS[health]} {health}{since}</b>'
        f"<span>{state}</span><span>{fold}</span><span>{at}</span></div>"
        f"<div>{_remedy(status, origin, unit)}</div></div>"
    )


def _remedy(status: Status, origin: int | None, unit: Unit) -> str:
    if status.lost is not None:
        when = "" if origin is None else f" since {unit.text((status.lost - origin) * 1e-9)}"
        return f"The estimate is not a number{when}: reset it, or choose another filter."
    if status.health == DIVERGED and not status.cause:
        return "The readings contradict the estimate."
    more = f" ({status.episodes_open - 1} more)" if status.cause and status.episodes_open > 1 else ""
    return html.escape(status.cause) + more


def note_html(text: str, palette: Palette = LIGHT) -> str:
    """One line in red, or nothing."""
    if not text:
        return ""
    color = "rgb({},{},{})".format(*palette.health["diverged"])
    return f'<div style="{STYLE};color:{color}">{html.escape(text)}</div>'
