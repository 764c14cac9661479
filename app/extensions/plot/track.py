"""Charts as files, without a browser: the estimate of a fold, drawn by Matplotlib (`pip install 'nisus[plot]'`)."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence
from functools import cached_property
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from app.charts.chart_stream import drawn
from app.charts.colors import LIGHT, RGB
from app.charts.direct_readings import measured_by
from app.charts.levels_of_detail import grouped
from app.columns import DOTS, columns_of, rows_of, units_by_name
from estimators.diagnostics.episodes import Episode
from estimators.errors import ConfigError
from estimators.log import Events
from estimators.model.state_space import StateSpaceModel
from estimators.track import Track

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FORMATS = (".png", ".pdf", ".svg")
MAX_STATES = 8
"""States in one picture; those that no sensor measures come first."""

MAX_INNOVATIONS = 6
"""Sensor rows whose innovations are drawn; those with most measurements come first."""

MAX_DOTS = 10_000
"""Dots of a column; of more, a random sample and the extremes of 500 groups are drawn, a tenth of all."""

MAX_GAP_STEPS = 20.0
"""Usual intervals between measurements after which the band of innovations is interrupted."""

MAX_GROUPS = 1500
"""Groups of rows into which a long log is cut; each is drawn as its two extremes."""

PANEL_INCHES = (9.0, 1.9)
LABEL_WIDTH = 22
"""Characters of a panel's label in one line."""


class TimeUnit(NamedTuple):
    """Unit of the time axis, with the digits after the point that a time has in it."""

    name: str
    seconds: float
    digits: int

    def text(self, seconds: float) -> str:
        """Return a time in this unit, for example `3.50 min`."""
        return f"{seconds / self.seconds:.{self.digits}f} {self.name}"


SECONDS = TimeUnit("s", 1.0, 1)
TIME_UNITS = (SECONDS, TimeUnit("min", 60.0, 2), TimeUnit("h", 3600.0, 3), TimeUnit("d", 86400.0, 4))


def time_unit(span: float) -> TimeUnit:
    """Return the largest unit of which `span` seconds hold at least three, or seconds."""
    return [unit for unit in TIME_UNITS if span >= 3.0 * unit.seconds or unit is SECONDS][-1]


def plotter(path: Path | None = None) -> Callable[..., Figure]:
    """Return `plot_track`; refuse a file into which its figure cannot be drawn, before minutes of work.

    Raises:
        ConfigError: If its ending names no format, or Matplotlib is not installed.
    """
    if path is not None and path.suffix.lower() not in FORMATS:
        raise ConfigError(f"--plot {path}: must end in {', '.join(FORMATS)}")
    new_figure(1.0, 1.0)
    return plot_track


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure (inches), which needs no display.

    Raises:
        ConfigError: If Matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise ConfigError("pictures need Matplotlib: pip install 'nisus[plot]'") from None

    class FigureForNotebooks(Figure):
        """Figure that a notebook shows as the value of a cell, without pyplot."""

        def _repr_png_(self) -> bytes:
            file = BytesIO()
            self.savefig(file, format="png", dpi=100)
            return file.getvalue()

    return FigureForNotebooks(figsize=(width, height))


def hex_color(color: RGB) -> str:
    """Return a colour as `#rrggbb`."""
    return "#{:02x}{:02x}{:02x}".format(*color)


class TrackSeries:
    """Columns of a fold by name, over seconds since its first event, in as many points as a picture can show."""

    def __init__(self, model: StateSpaceModel, events: Events, track: Track, max_groups: int = MAX_GROUPS) -> None:
        self.model, self.events, self.track = model, events, track
        self._columns = columns_of(model)
        self._size = max(1, -(-len(events) // max_groups))

    def __getitem__(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return seconds (n,) and values (n,) of a column, without its gaps in time."""
        values = self.raw(name)
        if self._columns[name].kind == DOTS:
            known = self._sampled(values)
            return (self.events.t[known] - int(self.events.t[0])) * 1e-9, values[known]
        groups = grouped(self._size, 0, self.events.t, values[:, None])
        times, points = drawn(groups, np.array([self._columns[name].kind]))
        return (times - int(self.events.t[0])) * 1e-9, points[:, 0]

    def _sampled(self, values: np.ndarray) -> np.ndarray:
        """Return the indices of the dots that are drawn: all, or a random sample and the extremes of each group."""
        known = np.flatnonzero(np.isfinite(values))
        if known.size <= MAX_DOTS:
            return known
        parts = np.array_split(known, MAX_DOTS // 20)
        extremes = [part[[np.argmin(values[part]), np.argmax(values[part])]] for part in parts]
        sample = np.random.default_rng(0).choice(known, MAX_DOTS - 2 * len(parts), replace=False)
        return np.unique(np.concatenate((*extremes, sample)))

    def raw(self, name: str) -> np.ndarray:
        """Return all values of a column, (rows,), NaN where there is none."""
        return self._columns[name].values(self.events, self.track)

    @cached_property
    def measured_by(self) -> dict[str, list[str]]:
        """Names of the sensor rows that measure a state directly, by state."""
        return measured_by(self.model)


def draw_state(axes: Axes, series: TrackSeries, name: str, *, unit: TimeUnit = SECONDS) -> None:
    """Draw a state over time: estimate with ± 2 σ, measurements, rejected ones, and the truth where it is known.

    An angle is drawn between -π and π.
    """
    estimate, measured, rejected = (hex_color(color) for color in (LIGHT.estimate, LIGHT.reading, LIGHT.refused))
    state = next(item for item in series.model.shown_states if item.name == name)
    turn = 2.0 * np.pi if state.circular else np.inf

    def plot(seconds: np.ndarray, values: np.ndarray, **style: Any) -> None:
        if np.isfinite(values).any():
            axes.plot(seconds / unit.seconds, values, **{"clip_on": False, "mew": 0, **style})

    def dots(kind: str, label: str, **style: Any) -> None:
        for k, row in enumerate(series.measured_by.get(name, [])):
            seconds, values = series[f"{kind}:{row}"]
            known = np.isfinite(values)
            plot(
                seconds[known],
                _wrapped(values[known], turn),
                **{"ls": "", **style, "label": "" if k else label},
            )

    seconds, mean = series[f"mean:{name}"]
    turned = mean - _wrapped(mean, turn)
    edges = [series[f"{kind}:{name}"][1] - turned for kind in ("lower", "upper")]
    mean = mean - turned
    # The line leaves the chart at π and comes back at -π.
    for values in (*edges, mean):
        values[1:][np.abs(np.diff(mean)) > 0.5 * turn] = np.nan
    if (edges[1] > edges[0]).any():  # a probability has no band
        axes.fill_between(
            seconds / unit.seconds, *edges, color=estimate, alpha=0.16, lw=0, label="± 2 σ", clip_on=False
        )
    dots("reading", "measurement", marker="o", ms=2.2, color=measured)
    dots("held", "held out", marker="o", ms=2.6, mfc="none", mew=0.6, mec=measured)
    plot(seconds, mean, color=estimate, lw=1.3, label="estimate")
    dots("refused", "rejected", marker="o", ms=3.2, color=rejected)
    dots("screened", "implausible", marker="x", ms=3.2, mew=0.8, color=rejected)
    seconds, truth = series[f"truth:{name}"]
    known = np.isfinite(truth)
    truth = _wrapped(truth[known], turn)
    truth[1:][np.abs(np.diff(truth)) > 0.5 * turn] = np.nan
    plot(seconds[known], truth, color=hex_color(LIGHT.truth), lw=0.9, ls=(0, (4, 3)), label="truth")


def _wrapped(values: np.ndarray, turn: float) -> np.ndarray:
    """Return values less whole turns, between minus and plus half a turn; a copy if `turn` is infinite."""
    return values - turn * np.round(values / turn) if np.isfinite(turn) else values.copy()


def draw_innovation(axes: Axes, series: TrackSeries, name: str, unit: TimeUnit) -> None:
    """Draw the innovations of a sensor row with their ± 2 σ; those beyond the chart are triangles at its edge."""
    used, rejected, band = (hex_color(color) for color in (LIGHT.reading, LIGHT.refused, LIGHT.bound))
    seconds, upper = series[f"innovation_upper:{name}"]
    known = np.isfinite(upper)
    seconds, upper = seconds[known], upper[known]
    low, usual = series[f"innovation_lower:{name}"][1][known], float(np.median(upper))
    steps = np.diff(seconds, prepend=seconds[:1])
    upper[steps > MAX_GAP_STEPS * np.median(steps)] = np.nan  # a dropout has no band
    axes.fill_between(seconds / unit.seconds, low, upper, color=band, alpha=0.3, lw=0, label="± 2 σ")
    seconds, values = series[f"innovation:{name}"]
    was_rejected = np.isin(seconds, series[f"refused:{name}"][0])
    judged = np.abs(values[~was_rejected] if (~was_rejected).any() else values)
    edge = 1.05 * max(float(np.quantile(judged, 0.995, method="higher")), 2.0 * usual)
    beyond = np.abs(values) > edge
    for mask, color, label in ((~was_rejected, used, "innovation"), (was_rejected, rejected, "rejected")):
        style: dict[str, Any] = {"ls": "", "mew": 0, "color": color}
        far = mask & beyond
        for part, marker, text in (
            (mask & ~beyond, "o", label),
            (far & (values > 0.0), "^", f"{label}, off the chart"),
            (far & (values < 0.0), "v", None if (far & (values > 0.0)).any() else f"{label}, off the chart"),
        ):
            if part.any():
                shown = np.clip(values[part], -edge, edge)
                size = 2.0 if marker == "o" else 4.0
                axes.plot(seconds[part] / unit.seconds, shown, marker=marker, ms=size, label=text, **style)
    axes.axhline(0.0, color=hex_color(LIGHT.previous), lw=0.6)
    # Room for the legend above.
    axes.set_ylim(-1.1 * edge, 1.6 * edge)


def draw_nis(axes: Axes, series: TrackSeries, unit: TimeUnit) -> None:
    """Draw the NIS: its windowed mean with the 95 % bounds of a consistent filter, and that of each measurement."""
    seconds, low = series["nis_low"]
    high = series["nis_high"][1]
    bound, faint = hex_color(LIGHT.bound), hex_color(LIGHT.previous)
    axes.fill_between(seconds / unit.seconds, low, high, color=bound, alpha=0.25, lw=0, label="95 % bounds")
    dots, values = series["nis"]
    axes.plot(dots / unit.seconds, values, ls="", marker=".", ms=1.5, color=faint, label="NIS of a measurement")
    seconds, mean = series["nis_mean"]
    axes.plot(seconds / unit.seconds, mean, color=hex_color(LIGHT.estimate), lw=1.3, label="windowed mean")
    axes.set_yscale("log")
    middle = np.nanmedian(np.concatenate((low, high))) if np.isfinite(low).any() else 1.0
    axes.set_ylim(0.05 * middle, max(50.0 * middle, 3.0 * np.nanmax(mean, initial=0.0)))


def plot_track(
    model: StateSpaceModel, events: Events, track: Track, *, episodes: Sequence[Episode] = (), title: str = ""
) -> Figure:
    """Draw a fold: a panel per state with its measurements, one per sensor row with its innovations, and the NIS.

    Args:
        model: Model of the fold.
        events: The log's events, n of them.
        track: Their rows, n of them.
        episodes: Faults, shaded from start to end.
        title: Above the first panel.

    Returns:
        A `matplotlib.figure.Figure`; `figure.savefig(path)` writes it.

    Raises:
        ConfigError: If Matplotlib is not installed.
    """
    series = TrackSeries(model, events, track)
    states = sorted(model.shown_states, key=lambda state: state.name in series.measured_by)[:MAX_STATES]
    counts = {name: int(np.isfinite(series.raw(f"innovation:{name}")).sum()) for name, _, _ in rows_of(model)}
    measured = [name for name in sorted(counts, key=lambda name: -counts[name])[:MAX_INNOVATIONS] if counts[name]]
    measured = [name for name in counts if name in measured]
    figure = new_figure(PANEL_INCHES[0], PANEL_INCHES[1] * (len(states) + len(measured) + 1))
    span = events.seconds
    unit, first, units = time_unit(float(span)), int(events.t[0]) * 1e-9, units_by_name(model)
    panels = figure.subplots(len(states) + len(measured) + 1, 1, sharex=True, squeeze=False)[:, 0]
    for axes, state in zip(panels, states, strict=False):
        draw_state(axes, series, state.name, unit=unit)
        _label(axes, model.label(state.name), state.unit)
        axes.set_ylim((-3.3, 5.0) if state.circular else _extent(series, state.name))
    for axes, name in zip(panels[len(states) :], measured, strict=False):
        draw_innovation(axes, series, name, unit)
        _label(axes, f"innovation of {name}", units[name])
    draw_nis(panels[-1], series, unit)
    panels[-1].set_ylabel("NIS", fontsize=9)
    panels[-1].set_xlabel(f"time [{unit.name}]")
    panels[-1].set_xlim(0.0, max(float(span), 1e-9) / unit.seconds)
    for axes in panels:
        for artist in (*axes.lines, *axes.collections):
            artist.set_clip_on(True)
        axes.grid(color=hex_color(LIGHT.grid), lw=0.6)
        axes.tick_params(labelsize=8)
        for grade in ("advisory", "suspect"):
            own = [item for item in episodes if (item.grade == "advisory") == (grade == "advisory")]
            shade = hex_color(LIGHT.health[grade])
            for start, end in _spans([(item.start - first, item.end and item.end - first) for item in own], span):
                axes.axvspan(start / unit.seconds, end / unit.seconds, color=shade, alpha=0.12, lw=0)
        axes.legend(fontsize=7, ncols=6, loc="upper left", framealpha=0.85, edgecolor="none", borderaxespad=0.2)
    left_out = [
        f"{len(names)} of {total} {what}"
        for names, total, what in (
            (states, len(model.shown_states), "states"),
            (measured, sum(map(bool, counts.values())), "sensor rows"),
        )
        if len(names) < total
    ]
    panels[0].set_title(", ".join(filter(None, [title, *left_out])), fontsize=10, loc="left")
    figure.align_ylabels()
    figure.set_layout_engine("constrained")
    return figure


def _spans(episodes: Sequence[tuple[float, float | None]], last: float) -> list[tuple[float, float]]:
    """Return the times with at least one episode; an open one lasts to `last`."""
    found: list[tuple[float, float]] = []
    for start, end in sorted((start, last if end is None else end) for start, end in episodes):
        if found and start <= found[-1][1]:
            found[-1] = found[-1][0], max(found[-1][1], end)
        else:
            found.append((start, end))
    return found


def _label(axes: Axes, words: str, unit: str) -> None:
    """Label a panel with a quantity and its unit."""
    words = words.replace("_", " ")
    text = words if unit in ("", "1") else f"{words} [{unit}]"
    axes.set_ylabel(textwrap.fill(text, LABEL_WIDTH), fontsize=9)


def _extent(series: TrackSeries, name: str) -> tuple[float, float]:
    """Return the limits of a state's chart: all but the first tenth of the band, which may start with a wide prior."""
    bands = [series[f"{kind}:{name}"][1] for kind in ("upper", "lower")]
    lines = [series[f"{kind}:{name}"][1] for kind in ("mean", "truth")]
    values = np.concatenate([*(band[len(band) // 10 :] for band in bands), *lines])
    values = values[np.isfinite(values)]
    low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 1.0)
    margin = 0.06 * (high - low) or 0.5
    # Room for the legend above.
    return low - margin, high + 4.0 * margin
