"""Charts of a report: the page's own chart code with its data, embedded in one HTML file.

Every kind of chart of the page (`app/web/page/charts`) is in the report too.
"""

from __future__ import annotations

import base64
import json
import posixpath
import re
from collections.abc import Mapping, Sequence

import numpy as np

from config.schema import GridAxis, ViewSection
from estimators.diagnostics.episodes import Episode
from estimators.diagnostics.sensitivity import Bound
from estimators.log import Events
from estimators.model.state_space import StateSpaceModel
from estimators.smoothing.walk import Smoothed
from estimators.track import USED, Track
from estimators.tuning import Tuning

from ..charts.chart_stream import ChartQuery, ChartStream
from ..charts.charted_run import ChartedRun, KeptRows
from ..charts.colors import PAGE
from ..charts.direct_readings import measured_by
from ..charts.sensor_groups import sensor_groups
from ..columns import columns_of, rows_of
from ..engine.copies import Pull
from ..engine.notices import Annotation
from ..result import JsonObject

MAX_GROUPS = 400
"""Groups of rows, of each of which the extremes are drawn."""

IMPORT = re.compile(r'(?<=from )"(\.{1,2}/[\w./]+)"')

FRAME = """<style>
{style}
</style>
<div id="charts"></div>
<noscript>Open this file in a browser that runs scripts to see the charts.</noscript>
<script id="chart-data" type="application/json">{data}</script>
<script type="importmap">{modules}</script>
<script>{uplot}</script>
<script type="module">import "nisus/report.js";</script>"""


def charts_html(
    tuning: Tuning,
    events: Events,
    track: Track,
    episodes: Sequence[Episode],
    bounds: Mapping[str, Bound] | None,
    smoothed: Smoothed | None,
    annotations: Sequence[Annotation] = (),
    view: ViewSection | None = None,
) -> str:
    """Return the charts of a run as HTML that loads nothing; times count from the first event."""
    model = tuning.model
    streams = {"live": _frame(tuning, events, track)}
    if smoothed is not None:
        streams["smoothed"] = _frame(tuning, events, smoothed.instead_of(track), ("mean:", "upper:", "lower:"))
    start = float(events.t[0]) * 1e-9
    kinds = sorted(path.name for path in (PAGE / "charts").glob("*.js"))
    data = {
        "model": charted_model(model, view or ViewSection()) | {"commissioned": tuning.baseline is not None},
        "nis_dof": float(track.dof[used].mean()) if (used := track.verdict == USED).any() else 1.0,
        "kinds": kinds,
        "streams": streams,
        "episodes": [
            {
                "subject": item.subject,
                "from": item.start - start,
                "to": None if item.end is None else item.end - start,
            }
            for item in episodes
        ],
        "annotations": [{"from": (note.t - int(events.t[0])) * 1e-9, "text": note.text} for note in annotations],
        "integrity": {
            name: {"bound": float(item.bound)} for name, item in (bounds or {}).items() if np.isfinite(item.bound)
        },
    }
    css = (PAGE / "chart.css").read_text(), (PAGE / "vendor" / "uPlot.min.css").read_text()
    return FRAME.format(
        style="\n".join(css),
        data=_script(data),
        modules=_script({"imports": _modules(["report.js", *(f"charts/{name}" for name in kinds)])}),
        uplot=(PAGE / "vendor" / "uPlot.iife.min.js").read_text(),
    )


def _frame(tuning: Tuning, events: Events, track: Track, kinds: tuple[str, ...] = ("",)) -> str:
    """Return the rows as a frame of a chart stream, without columns that have no value."""
    columns = columns_of(tuning.model)
    pull = Pull(0, False, 0, events, track)
    names = tuple(
        name
        for name, column in columns.items()
        if name.startswith(kinds) and np.isfinite(column.values(events, track)).any()
    )
    run, origin = ChartedRun(KeptRows(pull), columns), int(events.t[0])
    stream = ChartStream("report", ChartQuery(names, points=MAX_GROUPS), columns)
    stream.select(run, origin, int(events.t[-1]))
    run.sync(stream.levelled)
    return base64.b64encode(stream.frame(run, origin) or b"").decode()


def _modules(names: Sequence[str]) -> dict[str, str]:
    """Return an import map with these modules of the page, and all that they import, as data URLs."""
    found: dict[str, str] = {}
    left = list(names)
    while left:
        name = left.pop()
        if f"nisus/{name}" in found:
            continue

        def absolute(match: re.Match[str], folder: str = posixpath.dirname(name)) -> str:
            left.append(posixpath.normpath(posixpath.join(folder, match[1])))
            return f'"nisus/{left[-1]}"'

        code = base64.b64encode(IMPORT.sub(absolute, (PAGE / name).read_text()).encode()).decode()
        found[f"nisus/{name}"] = f"data:text/javascript;base64,{code}"
    return found


def _script(value: object) -> str:
    """Return JSON that cannot end the script element around it."""
    return json.dumps(value, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")


NUMBERED = re.compile(r"(.+?)(?:_(\d+)|\[([\d,]+)\])$")
"""Numbered states ("v1_3") and cells of a field ("t2m[13,20]")."""


def page_labels(model: StateSpaceModel, view: ViewSection) -> dict[str, str]:
    """Return the labels of states, sensors, rows and parameters by name, as far as they are not the names."""
    found, field = dict(view.labels), model.grid
    grid = view.grid if field is not None and view.grid and len(view.grid) == len(field.shape) else None

    def named(name: str) -> str:
        return found.get(name, name.replace("_", " "))

    for state in model.shown_states:
        base, number, cell = part.groups() if (part := NUMBERED.match(state.name)) else (state.name, None, None)
        if grid is not None and cell:
            found[state.name] = f"{named(base)} {_position(grid, [int(index) for index in cell.split(',')])}"
        elif (number or cell) and base in view.labels:
            found.setdefault(state.name, f"{named(base)} {number or cell}")
    for name, sensor, row in rows_of(model):
        of, position = model.sensors[sensor], model.sensors[sensor].rows[row].position
        if grid is not None and field is not None and position is not None:
            cells = [place / step for place, step in zip(position, field.steps, strict=True)]
            found.setdefault(name, f"{named(of.name)} {_position(grid, cells)}")
        elif of.name in view.labels and name != of.name:
            found.setdefault(name, f"{named(of.name)} {of.rows[row].name.replace('_', ' ')}")
    return found


OPPOSITE = {"° N": "° S", "° E": "° W"}
"""Units of positions below zero."""


def _position(grid: Sequence[GridAxis], cell: Sequence[float]) -> str:
    """Return the position of a cell in words: "54.75° N 5° W"."""
    places = []
    for axis, index in zip(grid, cell, strict=True):
        value, below = round(axis.first + index * axis.step, 6), OPPOSITE.get(axis.unit)
        text = f"{abs(value):g}{below}" if value < 0 and below else f"{value:g}{axis.unit}"
        places.append(text if "°" in axis.unit else f"{value:g} {axis.unit}")
    return " ".join(places) if any("°" in axis.unit for axis in grid) else f"at {', '.join(places)}"


def charted_model(model: StateSpaceModel, view: ViewSection) -> JsonObject:
    """Return states and sensor rows as charts need them: names, labels, units, and which rows measure which state."""
    measured, labels = measured_by(model), page_labels(model, view)
    return {
        "labels": labels,
        "groups": [
            {"name": group.name, "sensors": [model.sensor_names[k] for k in group.members], "declared": group.declared}
            for group in sensor_groups(model)
        ],
        "states": [
            {
                "name": state.name,
                "label": labels.get(state.name) or model.label(state.name).replace("_", " "),
                "unit": state.unit,
                "circular": bool(getattr(state, "circular", False)),
                "probability": j == model.mode,
                "rows": measured.get(state.name, []),
            }
            for j, state in enumerate(model.shown_states)
        ],
        "rows": [
            {"name": name, "sensor": model.sensor_names[sensor], "unit": model.sensors[sensor].rows[row].unit}
            for name, sensor, row in rows_of(model)
        ],
    }
