"""The charts of a run, for paper: every state, those that nobody measures first, NIS, and the innovations."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from estimators.diagnostics.episodes import Episode
from estimators.log import Events
from estimators.model.state_space import StateSpaceModel
from estimators.smoothing.walk import Smoothed
from estimators.track import Track

from ..drawing.colors import LIGHT, RGB
from ..drawing.direct_readings import observed
from ..series.chart_stream import drawn
from ..series.columns import columns_of, rows_of
from ..series.levels_of_detail import Groups, grouped
from .extent import extent
from .svg import Frame, Layer, chart

MOST = 24
"""Charts of states, and of rows."""

POINTS = 400
"""Groups of rows, of each of which the extremes are drawn."""

TALL, LOW = 190, 120
"""Pixels."""

SMOOTHED = ("mean:", "upper:", "lower:")
"""Columns of which there are smoothed ones."""

DECADES = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0)


def _hex(color: RGB, alpha: str = "") -> str:
    return "#" + "".join(f"{part:02x}" for part in color) + alpha


ESTIMATE, BAND, TRUTH = _hex(LIGHT.estimate), _hex(LIGHT.estimate, "26"), _hex(LIGHT.truth)
READING, REFUSED, BOUND = _hex(LIGHT.reading), _hex(LIGHT.refused), _hex(LIGHT.bound)
LATER = _hex(LIGHT.smoothed)
BOUNDS, QUIET = _hex(LIGHT.bound, "22"), _hex(LIGHT.previous)


def run_charts(
    model: StateSpaceModel,
    events: Events,
    track: Track,
    episodes: Sequence[Episode],
    smoothed: Smoothed | None = None,
) -> list[str]:
    """The charts as SVG; times count from the first event."""
    return _Charts(model, events, track, episodes, smoothed).all() if len(events) else []


class _Charts:
    def __init__(
        self,
        model: StateSpaceModel,
        events: Events,
        track: Track,
        episodes: Sequence[Episode],
        smoothed: Smoothed | None,
    ) -> None:
        self._model, self._made = model, 0
        size = -(-len(events) // POINTS)
        self._columns = {
            name: column
            for name, column in columns_of(model).items()
            if not name.startswith(("input:", "health", "effective", "ancestors"))
        }
        self._origin = int(events.t[0])
        values = np.column_stack([column.values(events, track) for column in self._columns.values()])
        groups: Groups = grouped(size, 0, events.t, values)
        times, points = drawn(groups, np.array([column.kind for column in self._columns.values()]))
        self._x = (times - self._origin) * 1e-9
        self._points = dict(zip(self._columns, points.T, strict=True))
        self._smoothed: dict[str, np.ndarray] = {}
        if smoothed is not None:
            names = [name for name in self._columns if name.startswith(SMOOTHED)]
            values = np.column_stack([self._columns[name].values(events, smoothed.instead_of(track)) for name in names])
            kinds = np.array([self._columns[name].kind for name in names])
            points = drawn(grouped(size, 0, events.t, values), kinds)[1]
            self._smoothed = dict(zip(names, points.T, strict=True))
        end = float(self._x[-1])
        self._span = (0.0, max(end, 1e-9))
        start = self._origin * 1e-9
        self._shades = [(item.start - start, end if item.end is None else item.end - start) for item in episodes]

    def all(self) -> list[str]:
        model = self._model
        readers: dict[int, list[str]] = {}
        names = {(sensor, row): name for name, sensor, row in rows_of(model)}
        for dot in observed(model):
            readers.setdefault(int(dot.state), []).append(names[dot.sensor, dot.row])
        shown = [(int(j), state) for j, state in zip(model.shown, model.shown_states, strict=True)]
        shown.sort(key=lambda item: item[0] in readers)
        found = [self._state(j, state, readers.get(j, [])) for j, state in shown[:MOST]]
        rows = [self._innovation(name, sensor, row) for name, sensor, row in rows_of(model)[:MOST]]
        return [*found, self._nis(), *rows]

    def _state(self, j: int, state: object, readers: list[str]) -> str:
        name, unit = state.name, state.unit  # type: ignore[attr-defined]
        upper, lower, mean, truth = (self._points[f"{kind}:{name}"] for kind in ("upper", "lower", "mean", "truth"))
        if getattr(state, "circular", False):
            turned = mean - _turn(mean)
            upper, lower = upper - turned, lower - turned
            mean, truth = _unbroken(_turn(mean)), _unbroken(_turn(truth))
        layers = [Layer("± 2σ", BAND, self._x, upper, lower)] if j != self._model.mode else []
        for kind, said, color, radius, ring in (
            ("reading", "reading", READING, 1.5, False),
            ("held", "held out", READING, 2.0, True),
            ("refused", "refused", REFUSED, 2.5, False),
            ("screened", "screened", REFUSED, 2.5, True),
        ):
            dots = [self._points[f"{kind}:{row}"] for row in readers]
            layers += [
                Layer(said if k == 0 else "", color, self._x, values, radius=radius, ring=ring)
                for k, values in enumerate(item for item in dots if np.isfinite(item).any())
            ]
        known = np.isfinite(truth)
        if known.any():
            layers.append(Layer("truth", TRUTH, self._x[known], truth[known], width=1.2, dash="5 3"))
        layers.append(Layer("estimate", ESTIMATE, self._x, mean, width=1.6))
        layers += self._smoothed_layers(name, circular=getattr(state, "circular", False))
        lines = [layer.y for layer in layers if layer.low is None and not layer.radius]
        spanned = extent(lines, [(lower, upper)], [layer.y for layer in layers if layer.radius])
        if j == self._model.mode:
            spanned = (-0.03, 1.03)
        note = "" if readers else "not measured"
        label = self._model.label(name).replace("_", " ")
        return self._drawn(label, unit, note, TALL, spanned, layers)

    def _smoothed_layers(self, name: str, *, circular: bool) -> list[Layer]:
        """Its mean, and an edge of its band to either side."""
        if not self._smoothed:
            return []
        mean = self._smoothed[f"mean:{name}"]
        turned = mean - _turn(mean) if circular else np.zeros_like(mean)
        layers = []
        for kind, said, width in (("upper", "", 0.75), ("lower", "", 0.75), ("mean", "smoothed", 1.25)):
            values = self._smoothed[f"{kind}:{name}"] - turned
            layers.append(Layer(said, LATER, self._x, _unbroken(values) if circular else values, width=width))
        return layers

    def _nis(self) -> str:
        nis, mean, low, high = (_log(self._points[name]) for name in ("nis", "nis_mean", "nis_low", "nis_high"))
        middle = float(np.nanmedian((low + high) / 2)) if np.isfinite(low + high).any() else 0.0
        finite = mean[np.isfinite(mean)]
        bottom = min(middle - 1.0, float(finite.min()) - 0.15) if finite.size else middle - 1.0
        top = max(middle + 1.0, float(finite.max()) + 0.15) if finite.size else middle + 1.0
        dots = np.where(nis < bottom, np.nan, nis)
        layers = [
            Layer("95 % bounds", BOUNDS, self._x, high, low),
            Layer("of a reading", QUIET, self._x, dots, radius=1.2),
            Layer("mean", ESTIMATE, self._x, mean, width=1.6),
        ]
        marks = tuple((float(np.log10(v)), f"{v:g}") for v in DECADES if bottom <= np.log10(v) <= top)
        return self._drawn("NIS", "", "mean of the last readings", TALL, (bottom, top), layers, marks, _power)

    def _innovation(self, name: str, sensor: int, row: int) -> str:
        over, under, values = (
            self._points[f"{kind}:{name}"] for kind in ("innovation_upper", "innovation_lower", "innovation")
        )
        known = np.isfinite(over)
        layers = [
            Layer("± 2σ expected", BOUNDS, self._x[known], over[known], under[known]),
            Layer("reading − prediction", READING, self._x, values, radius=1.3),
        ]
        low, high = extent([], [(under, over)], [values])
        most = max(abs(low), abs(high))
        unit = self._model.sensors[sensor].rows[row].unit
        return self._drawn(f"{name.replace('_', ' ')}: innovation", unit, "", LOW, (-most, most), layers)

    def _drawn(
        self,
        title: str,
        unit: str,
        note: str,
        height: int,
        spanned: tuple[float, float],
        layers: list[Layer],
        marks: tuple[tuple[float, str], ...] | None = None,
        says: Callable[[float], str] | None = None,
    ) -> str:
        self._made += 1
        frame = Frame(f"chart{self._made}", title, unit, note, height, self._span, spanned, marks, says)
        return chart(frame, layers, self._shades)


def _turn(angles: np.ndarray) -> np.ndarray:
    """Angles between -π and π."""
    return angles - 2.0 * np.pi * np.round(angles / (2.0 * np.pi))


def _unbroken(angles: np.ndarray) -> np.ndarray:
    """A curve of angles, which leaves the chart at one edge and comes back at the other."""
    out = angles.copy()
    out[1:][np.abs(np.diff(angles)) > np.pi] = np.nan
    return out


def _power(decades: float) -> str:
    return f"{10.0**decades:.3g}"


def _log(values: np.ndarray) -> np.ndarray:
    out: np.ndarray = np.log10(np.maximum(values, 1e-9))
    return out
