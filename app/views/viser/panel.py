"""The panel of Viser's own window: health, a few controls and a chart of the NIS. The page has all other controls."""

from __future__ import annotations

import html
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import viser

from estimators.errors import ConfigError
from estimators.registry import ESTIMATORS, unfit
from estimators.track import DIVERGED, HEALTH_NAMES, TRACKING

from ...live.commands import Command, Reset, SetEstimator, SetTuning
from ...live.outputs import Status
from ...live.running_fold import Running
from ...present.drawing.colors import LIGHT, RGB, Palette, round_step
from ...present.drawing.plot import SECONDS, TimeUnit, time_unit
from ...present.series.chart_stream import drawn
from ...present.series.charted_run import ChartedRun
from ...present.series.columns import columns_of
from ...present.series.levels_of_detail import FACTOR
from .stage import Choice, Stage

CHART_PERIOD_S = 0.5
PANEL_WIDTH_PX = 360
SLIDER_DECADES = 3.0  # Powers of ten that a slider reaches to either side of the configured variance

EDIT_HOLD_S = 2.0
"""Seconds after an edit in which the controls are not set to the engine's older values."""

GATES = {"off": None, "95 %": 0.95, "99 %": 0.99, "99.9 %": 0.999, "99.99 %": 0.9999}
SIGNS = dict(zip(HEALTH_NAMES, "○●◆◐▲✖◌", strict=True))
"""Each health state has a sign of its own, for users who cannot distinguish the colours."""

STYLE = "padding:0.2em 1.4em 0.6em 0.9em;font-size:0.85em;line-height:1.6;overflow-wrap:anywhere"


class Panel:
    """Status, controls and NIS chart. `sync` updates them from the engine."""

    def __init__(self, server: viser.ViserServer, engine: Running, stage: Stage) -> None:
        self._engine, self._stage = engine, stage
        self._unit = time_unit(engine.twin.config.view.window)
        self._shown: dict[str, Any] = {}
        gui = self._gui = server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=stage.palette.estimate)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(PANEL_WIDTH_PX)
        self.status = gui.add_html("")
        self.error = gui.add_html("")
        self.controls = Controls(gui, engine)
        self.nis = NisChart(gui, engine, self._unit)
        self._chart_drawn = -CHART_PERIOD_S
        self._scene = gui.add_folder("Scene")
        self.choices: dict[str, viser.GuiDropdownHandle[str]] = {}
        self._offer()

    def sync(self, origin: int | None) -> None:
        """Show the engine's state; `origin` (ns) is the time from which the charts count."""
        status = self._engine.status()
        self.controls.sync(status)
        self._show(self.status, "status", status_html(status, origin, self._unit, self._stage.palette))
        self._offer()
        now, state = time.monotonic(), (status.revision, self._engine.span(), origin)
        if origin is not None and now - self._chart_drawn >= CHART_PERIOD_S and self._shown.get("nis") != state:
            self._shown["nis"], self._chart_drawn = state, now
            self.nis.draw(origin)

    def _offer(self) -> None:
        """Show the choices that the present scene has, with their values."""
        offered, values = self._stage.choices.offered(), self._stage.choices.values()
        if self._shown.get("choices") != offered:
            self._shown["choices"] = offered
            for handle in self.choices.values():
                handle.remove()
            with self._scene:
                self.choices = {item.key: self._choice(item, values[item.key]) for item in offered}
            self._scene.visible = bool(offered)
        for key, handle in self.choices.items():
            if handle.value != values[key]:
                handle.value = values[key]

    def _choice(self, item: Choice, value: str) -> viser.GuiDropdownHandle[str]:
        handle = self._gui.add_dropdown(item.label, item.options, initial_value=value)
        handle.on_update(partial(self._choose, item.key))
        return handle

    def _choose(self, key: str, event: viser.GuiEvent) -> None:
        if event.client is None:
            return
        try:
            self._stage.choices.choose(key, event.target.value)
            self._show(self.error, "error", "")
        except ConfigError as error:
            self._show(self.error, "error", error_html(str(error), self._stage.palette))

    def _show(self, handle: Any, key: str, content: str) -> None:
        if self._shown.get(key) != content:
            self._shown[key] = content
            handle.content = content


class Controls:
    """Estimator, gate, variances and reset, generated from the tuning: each edit is one command."""

    def __init__(self, gui: viser.GuiApi, engine: Running) -> None:
        self._engine, self._edited = engine, -np.inf
        self.handles: dict[str, viser.GuiInputHandle[Any]] = {}
        self._values: dict[str, Callable[[Status], Any]] = {}
        status = engine.status()
        titles = {name: entry.title for name, entry in ESTIMATORS.items() if unfit(entry, engine.model) is None}
        names = {title: name for name, title in titles.items()}
        dropdown = gui.add_dropdown("Estimator", tuple(names), initial_value=titles[status.estimator])
        self._bind("estimator", dropdown, lambda title: SetEstimator(names[title]), lambda now: titles[now.estimator])
        gates = GATES | {_gate_text(status.tuning.gate): status.tuning.gate}
        gate = gui.add_dropdown("Gate", tuple(gates), initial_value=_gate_text(status.tuning.gate))
        self._bind("gate", gate, lambda text: SetTuning("gate", gates[text]), lambda now: _gate_text(now.tuning.gate))
        for item in engine.twin.tuning.items():
            if item.key[:2] in ("Q.", "R.") and item.value > 0.0:
                hint = f"Powers of ten from the configured {item.value:.4g} {item.unit}"
                label, limit = item.key.replace("_", " "), SLIDER_DECADES
                slider = gui.add_slider(label, -limit, limit, 0.01, 0.0, marks=((0.0, ""),), hint=hint)
                entry = (item.key, item.value)
                self._bind(item.key, slider, partial(_set_variance, *entry), partial(_decades, *entry))
        gui.add_button("Reset estimate").on_click(lambda event: engine.submit(Reset()))
        self.sync(status)

    def _bind(self, key: str, handle: Any, command: Callable[[Any], Command], value: Callable[[Status], Any]) -> None:
        def edited(event: viser.GuiEvent) -> None:
            # Viser also calls back when `sync` sets a value, then without a client.
            if event.client is not None:
                self._edited = time.monotonic()
                self._engine.submit(command(handle.value))

        handle.on_update(edited)
        self.handles[key], self._values[key] = handle, value

    def sync(self, status: Status) -> None:
        """Set the controls to the engine's values, unless the user has just edited one."""
        if time.monotonic() - self._edited < EDIT_HOLD_S:
            return
        for key, handle in self.handles.items():
            value = self._values[key](status)
            if handle.value != value and (key != "gate" or value in handle.options):
                handle.value = value


def _gate_text(gate: float | None) -> str:
    return "off" if gate is None else f"{100 * gate:.6g} %"


def _set_variance(key: str, configured: float, decades: float) -> SetTuning:
    return SetTuning(key, float(f"{configured * 10.0**decades:.3g}"))


def _decades(key: str, configured: float, status: Status) -> float:
    values = {item.key: item.value for item in status.tuning.items()}
    decades = np.log10(max(values[key] / configured, 10.0**-SLIDER_DECADES))
    return round(min(float(decades), SLIDER_DECADES), 2)


class NisChart:
    """Mean NIS of the last measurements with the 95 % bounds of a consistent filter."""

    COLUMNS = ("nis_high", "nis_low", "nis_mean")
    MAX_GROUPS = 100
    """Groups of rows that are drawn, each as two points."""

    MAX_HEIGHT = 4.0
    """Height of the chart in multiples of the upper bound: a bad start must not flatten the rest."""

    def __init__(self, gui: viser.GuiApi, engine: Running, unit: TimeUnit) -> None:
        self._engine, self._unit = engine, unit
        self._columns = columns_of(engine.model)
        self._kinds = np.array([self._columns[name].kind for name in self.COLUMNS])
        self._run: ChartedRun | None = None
        hidden, line = "rgba(0,0,0,0)", {"spanGaps": True, "points": {"show": False}}
        axis = {"font": "11px sans-serif", "stroke": _css(LIGHT.previous), "ticks": {"size": 4}}
        below = {"size": 24, "label": f"time [{unit.name}]", "labelSize": 14, "labelFont": "11px sans-serif"}
        self.handle = gui.add_uplot(
            self._nothing(),
            (
                {"label": "time"},
                {"label": "high", "stroke": hidden, "auto": False, **line},
                {"label": "low", "stroke": hidden, "auto": False, **line},
                {"label": "mean", "stroke": _css(LIGHT.estimate), "width": 1.5, "auto": False, **line},
                # uPlot finds no range of a series with NaN; this invisible one spans it for all.
                {"label": "range", "stroke": hidden, "width": 0, "points": {"show": False}},
            ),  # type: ignore[arg-type]
            title="NIS: windowed mean, 95 % bounds",
            bands=({"series": (1, 2), "fill": "rgba({},{},{},0.22)".format(*LIGHT.bound)},),
            scales={"x": {"time": False}},
            axes=(axis | below, axis | {"size": 44}),
            legend={"show": False},
            height=170,
            padding=(4, 14, 0, 0),
        )

    def _nothing(self) -> tuple[np.ndarray, ...]:
        return (np.array([0.0, 1.0]), *(np.full(2, np.nan) for _ in self.COLUMNS), np.array([0.0, 1.0]))

    def close(self) -> None:
        """Release the rows; the next `draw` takes them again."""
        if self._run is not None:
            self._run.close()
            self._run = None

    def draw(self, origin: int) -> None:
        """Send the charts' window, over time since `origin` (ns)."""
        if self._run is None:
            self._run = ChartedRun(self._engine, self._columns)
        self._run.sync(self.COLUMNS)
        newest = self._engine.span()[1]
        start, stop = self._run.span(newest - int(self._engine.twin.config.view.window * 1e9), newest + 1)
        size = 1
        while stop - start > self.MAX_GROUPS * size:
            size *= FACTOR
        groups = self._run.groups(size, -(-start // size), -(-stop // size), list(self.COLUMNS))
        times, points = drawn(groups, self._kinds)
        # uPlot joins the points on both sides of a NaN, so the line starts after the last one.
        unknown = np.flatnonzero(~np.isfinite(points[:, 2]))
        shown = slice(int(unknown[-1]) + 1 if unknown.size else 0, None)
        times, points = times[shown], points[shown]
        if times.size < 2:
            self.handle.data = self._nothing()
            return
        highest = float(points[:, 0].max())
        top = round_step(1.2 * max(highest, min(self.MAX_HEIGHT * highest, float(points[:, 2].max()))))
        ends = np.where(np.arange(times.size) % 2 == 0, 0.0, top)
        self.handle.data = ((times - origin) * (1e-9 / self._unit.seconds), *np.minimum(points, top).T, ends)


def status_html(status: Status, origin: int | None, unit: TimeUnit = SECONDS, palette: Palette = LIGHT) -> str:
    """Return health, run state, revision and time, and below them the cause; times count from `origin` (ns)."""
    health = HEALTH_NAMES[status.health]

    def since(t: int | None) -> str:
        return "" if t is None or origin is None else unit.text((t - origin) * 1e-9)

    begun = since(status.since) if status.health != TRACKING else ""
    state = "ended" if status.finished else "paused" if status.paused else ""
    fold = "folding again" if status.refolding else f"revision {status.revision}"
    if status.awaited is not None:
        fold = f"compiling {status.awaited}, {status.compiling.get(status.awaited) or 0.0:.0f} s"
    more = f" ({status.episodes_open - 1} more)" if status.cause and status.episodes_open > 1 else ""
    cause = html.escape(status.cause) + more
    if status.lost is not None:
        lost = f" since {since(status.lost)}" if origin is not None else ""
        cause = f"The estimate is not a number{lost}: reset it, or choose another filter."
    elif status.health == DIVERGED and not cause:
        cause = "The measurements contradict the estimate."
    return (
        f'<div style="{STYLE};font-variant-numeric:tabular-nums">'
        '<div style="display:flex;justify-content:space-between;gap:0.5em">'
        f'<b style="color:{_css(palette.health[health])};white-space:nowrap">{SIGNS[health]} {health}'
        f"{f' since {begun}' if begun else ''}</b>"
        f"<span>{state}</span><span>{fold}</span><span>{since(status.t)}</span></div><div>{cause}</div></div>"
    )


def error_html(text: str, palette: Palette = LIGHT) -> str:
    """Return one line in red."""
    return f'<div style="{STYLE};color:{_css(palette.health["diverged"])}">{html.escape(text)}</div>'


def _css(color: RGB) -> str:
    return "rgb({},{},{})".format(*color)
