"""A twin's picture for the gallery, as SVG: drawn from a fold of its own log, by what the twin is.

A field is a map, a vehicle its track among its walls, a battery the charge of its cells, three states without a unit
the curve that they draw, many a picture of state over time; and everything else a parameter that is estimated, a switch
or a state that nobody measures, with its band. Colours are the page's by name, so that light and dark are its own.
"""

from __future__ import annotations

import base64
import struct
import zlib
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from estimators.diagnostics.field_pictures import Picture
from estimators.fold import Fold
from estimators.log import Events, Log
from estimators.model.state_space import StateSpaceModel
from estimators.track import Track

from ..series.columns import Column, columns_of
from .colors import DEVIATION, ERROR, ESTIMATE, Kind, Scale, gradient, image_of
from .direct_readings import Observed, observed

WIDTH, HEIGHT, MARGIN = 320, 140, 8
POINTS = 150
"""Points along a line, about."""

DOTS = 120
"""Readings that are drawn, at most."""

MANY = 32
"""States from which on they are drawn as a picture over time."""

STYLE = (
    ".card-picture .estimate{fill:none;stroke:var(--estimate,#0b62c4);stroke-width:1.6;stroke-linejoin:round}"
    ".card-picture .band{fill:var(--band,#0b62c426);stroke:none}"
    ".card-picture .truth{fill:none;stroke:var(--truth,#111827);stroke-width:1.1;stroke-dasharray:4 3}"
    ".card-picture .reading{fill:var(--reading,#d98a00)}"
    ".card-picture .refused{fill:var(--refused,#cc3f0c)}"
    ".card-picture .cloud{fill:var(--estimate,#0b62c4);fill-opacity:.35}"
    ".card-picture .wall{fill:none;stroke:var(--faint,#5b6a7d);stroke-width:1.4}"
)


def picture_of(twin: Any, log: Log) -> str:
    """The picture of a twin (`app.twin.twin.Twin`) over a log.

    Raises:
        NisusError: If the fold fails.
    """
    model, scene, window = twin.model, twin.config.view.scene, twin.config.view.window
    fold = Fold(twin.estimator, model, twin.tuning, log, pairs=twin.pairs, picture=twin.picture)
    cloud = None
    if scene.kind == "vehicle":
        # A quarter into the window there may still be more than one place where it could be.
        fold.advance(int(np.searchsorted(log.t[: log.n], log.t[0] + round(0.25e9 * window))))
        cloud = fold.points() if fold.estimator.peaks is not None else None
    fold.advance()
    events, track = log.events, fold.track
    if model.grid is not None:
        return _svg(_maps(fold.pictures.taken if fold.pictures is not None else []))
    if scene.kind == "vehicle" and not scene.walls and _straight(model, scene.position, events, track):
        return _svg(_chart(model, [_most_refused(model, track, events)], events, track))
    if scene.kind == "vehicle":
        return _svg(_path(model, scene, events, track, cloud))
    if scene.kind == "battery":
        return _svg(_chart(model, scene.charge, events, track))
    if len(model.shown) >= MANY:
        return _svg(_over_time(track, int(np.searchsorted(events.t, events.t[0] + round(1e9 * window)))))
    names = scene.axes or model.state_names[:3]
    units = {model.states[model.state_names.index(name)].unit for name in names}
    if len(names) == 3 and units <= {"", "1"}:
        return _svg(_curve(model, names[0], names[2], events, track, round(1e9 * window)))
    sought = next(iter(twin.config.estimate), None) or _told_least(model)
    return _svg(_chart(model, [sought], events, track))


def _told_least(model: StateSpaceModel) -> str:
    """The switch, or the first state that no sensor reads, or the first of all."""
    if model.mode is not None and model.mode >= 0:
        return model.shown_states[model.mode].name
    read = {model.state_names[item.state] for item in observed(model)}
    names = [state.name for state in model.shown_states]
    return next((name for name in names if name not in read), names[0])


def _straight(model: StateSpaceModel, position: tuple[str, str], events: Events, track: Track) -> bool:
    """Whether a drive is a line, of which a map would say nothing."""
    columns = columns_of(model)
    points = np.stack([columns[f"mean:{name}"].values(events, track) for name in position])
    spread = np.linalg.eigvalsh(np.cov(points[:, np.isfinite(points).all(axis=0)]))
    return bool(spread[0] < 1e-3 * spread[1])


def _most_refused(model: StateSpaceModel, track: Track, events: Events) -> str:
    """The state of whose readings the gate refused most."""
    columns = columns_of(model)

    def refused(item: Observed) -> int:
        row = model.row_names[model.row_start[item.sensor] + item.row]
        return int(np.isfinite(columns[f"refused:{row}"].values(events, track)).sum())

    seen = observed(model)
    return model.state_names[max(seen, key=refused).state] if seen else _told_least(model)


def _chart(model: StateSpaceModel, names: Iterable[str], events: Events, track: Track) -> list[str]:
    """States over time with their bands, truth and readings; of several the one that is known least in full."""
    columns, names = columns_of(model), list(names)
    t = events.t * 1e-9
    read = {model.state_names[item.state]: item for item in observed(model)}
    place = _buckets(t)

    def values(kind: str, name: str) -> np.ndarray:
        column: Column = columns[f"{kind}:{name}"]
        return column.values(events, track)

    spread = {name: float(np.nanmean(values("upper", name) - values("lower", name))) for name in names}
    main = max(names, key=lambda name: spread[name])
    lines = {name: place(values("mean", name)) for name in names}
    upper, lower, truth = (place(values(kind, main)) for kind in ("upper", "lower", "truth"))
    dots, refused = np.full(t.size, np.nan), np.full(t.size, np.nan)
    if main in read:
        row = model.row_names[model.row_start[read[main].sensor] + read[main].row]
        dots, refused = values("reading", row), values("refused", row)
    # The prior's band may be as wide as all the world: what comes later sets the scale.
    later = slice(max(1, len(upper) // 10), None)
    shown = np.concatenate([*(line for line in lines.values()), truth, upper[later], lower[later]])
    y = _scale(shown, HEIGHT - MARGIN, MARGIN)
    x = np.linspace(MARGIN, WIDTH - MARGIN, len(upper))

    def marks(dots: np.ndarray, kind: str) -> list[str]:
        at = np.flatnonzero(np.isfinite(dots))
        at = at[:: max(1, at.size // DOTS)]
        across = np.interp(t[at], [t[0], t[-1]], [MARGIN, WIDTH - MARGIN])
        return [_dot(a, b, 1.5, kind) for a, b in zip(across, y(dots[at]), strict=True)]

    return [
        _band(x, y(upper), y(lower)),
        *marks(dots, "reading"),
        *(_line(x, y(line), "estimate") for line in lines.values()),
        *marks(refused, "refused"),
        _line(x, y(truth), "truth"),
    ]


def _path(model: StateSpaceModel, scene: Any, events: Events, track: Track, cloud: np.ndarray | None) -> list[str]:
    """Where a vehicle went, north up, among its walls."""
    columns, (east, north) = columns_of(model), scene.position
    t = events.t * 1e-9
    place = _buckets(t, 2 * POINTS)
    # Where it cannot be said yet where it is, there is no line.
    sure = sum(columns[f"upper:{name}"].values(events, track) - columns[f"lower:{name}"].values(events, track)
               for name in (east, north))  # fmt: skip
    known = sure < 4.0 * np.nanmedian(sure) + 1e-9
    mean = [place(np.where(known, columns[f"mean:{name}"].values(events, track), np.nan)) for name in (east, north)]
    truth = [place(columns[f"truth:{name}"].values(events, track)) for name in (east, north)]
    points = np.zeros((0, 2))
    if cloud is not None:
        indices = [model.state_names.index(name) for name in (east, north)]
        points = np.asarray(cloud)[:: max(1, len(cloud) // (2 * DOTS))][:, indices]
    walls = [np.array(wall, float).T for wall in scene.walls]
    if not walls:
        # Nothing says which way is up: along the picture there is most room.
        mean, truth = (_turned(*mean, *mean), _turned(*truth, *mean))
    all_x = np.concatenate([mean[0], truth[0], *(wall[0] for wall in walls)])
    all_y = np.concatenate([mean[1], truth[1], *(wall[1] for wall in walls)])
    x, y = _alike(all_x, all_y)
    return [
        *(_line(x(wall[0]), y(wall[1]), "wall") for wall in walls),
        *(_dot(float(x(a)), float(y(b)), 1.6, "cloud") for a, b in points),
        _line(x(truth[0]), y(truth[1]), "truth"),
        _line(x(mean[0]), y(mean[1]), "estimate"),
    ]


def _turned(x: np.ndarray, y: np.ndarray, along_x: np.ndarray, along_y: np.ndarray) -> list[np.ndarray]:
    """Points turned so that the longest axis of others lies flat."""
    others = np.stack([along_x, along_y])
    axis = np.linalg.eigh(np.cov(others[:, np.isfinite(others).all(axis=0)]))[1][:, -1]
    axis = axis * (np.sign(axis[0]) or 1.0)
    return [axis[0] * x + axis[1] * y, axis[0] * y - axis[1] * x]


def _curve(model: StateSpaceModel, first: str, last: str, events: Events, track: Track, span: int) -> list[str]:
    """Two states against each other, truth and estimate."""
    columns = columns_of(model)
    n = int(np.searchsorted(events.t, events.t[0] + span))
    rows = slice(0, n)
    told = [columns[f"truth:{name}"].values(events, track)[rows] for name in (first, last)]
    known = np.isfinite(told[0])
    mean = [columns[f"mean:{name}"].values(events, track)[rows] for name in (first, last)]
    across, up = (np.concatenate([mean[k], told[k]]) for k in (0, 1))
    x, y = _scale(across, MARGIN, WIDTH - MARGIN), _scale(up, HEIGHT - MARGIN, MARGIN)
    return [
        _line(x(mean[0]), y(mean[1]), "estimate"),
        _line(x(told[0][known]), y(told[1][known]), "truth"),
    ]


def _over_time(track: Track, n: int) -> list[str]:
    """Every state over time, as colours."""
    values = track.mean[:n][:: max(1, n // (2 * POINTS))].T
    return [_image(values, ESTIMATE, 0, 0, WIDTH, HEIGHT)]


def _maps(pictures: list[Picture]) -> list[str]:
    """A field at its last picture: estimate, and how far that is off or thought to be."""
    kept = [picture for picture in pictures if picture.mean is not None]
    if not kept:
        return []
    last = next((picture for picture in reversed(kept) if picture.truth is not None), kept[-1])
    kinds = [ESTIMATE, ERROR if last.truth is not None else DEVIATION]
    wide = (WIDTH - 3 * MARGIN) / 2
    return [
        _image(image, kind, MARGIN + k * (wide + MARGIN), MARGIN, wide, HEIGHT - 2 * MARGIN)
        for k, kind in enumerate(kinds)
        if (image := image_of(last, kind)) is not None
    ]


def _buckets(t: np.ndarray, points: int = POINTS) -> Callable[[np.ndarray], np.ndarray]:
    """The last known value in each of so many stretches of time; NaN where there is none."""
    edges = np.linspace(t[0], t[-1], points + 1)[1:]

    def place(values: np.ndarray) -> np.ndarray:
        known = np.flatnonzero(np.isfinite(values))
        if not known.size:
            return np.full(points, np.nan)
        last = np.searchsorted(t[known], edges, side="right") - 1
        out = np.where(last >= 0, values[known[np.maximum(last, 0)]], np.nan)
        # A gap longer than a tenth of the time is a gap.
        return np.where(edges - t[known[np.maximum(last, 0)]] < 0.1 * (t[-1] - t[0]), out, np.nan)

    return place


def _scale(values: np.ndarray, low: float, high: float) -> Callable[[Any], np.ndarray]:
    """Values to places between two, the least to the first."""
    finite = values[np.isfinite(values)]
    a, b = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    return lambda given: low + (np.asarray(given) - a) / ((b - a) or 1.0) * (high - low)


def _alike(x: np.ndarray, y: np.ndarray) -> tuple[Callable[[Any], np.ndarray], Callable[[Any], np.ndarray]]:
    """Both axes to one scale, in the middle of the picture."""
    (x0, x1), (y0, y1) = ((np.nanmin(v), np.nanmax(v)) for v in (x, y))
    scale = min((WIDTH - 2 * MARGIN) / max(x1 - x0, 1e-9), (HEIGHT - 2 * MARGIN) / max(y1 - y0, 1e-9))
    return (
        lambda given: WIDTH / 2 + (np.asarray(given) - (x0 + x1) / 2) * scale,
        lambda given: HEIGHT / 2 - (np.asarray(given) - (y0 + y1) / 2) * scale,
    )


def _line(x: np.ndarray, y: np.ndarray, kind: str) -> str:
    """A line, cut where a value is not known."""
    path, pen = "", False
    for a, b in zip(np.atleast_1d(x), np.atleast_1d(y), strict=True):
        if np.isfinite(a) and np.isfinite(b):
            path += f"{'L' if pen else 'M'}{a:.1f} {b:.1f}"
            pen = True
        else:
            pen = False
    return f'<path class="{kind}" d="{path}"/>' if path else ""


def _band(x: np.ndarray, upper: np.ndarray, lower: np.ndarray) -> str:
    known = np.isfinite(upper) & np.isfinite(lower)
    x, upper, lower = x[known], upper[known], lower[known]
    there = [f"{a:.1f} {b:.1f}" for a, b in zip(x, upper, strict=True)]
    back = [f"{a:.1f} {b:.1f}" for a, b in zip(x[::-1], lower[::-1], strict=True)]
    return f'<path class="band" d="M{"L".join([*there, *back])}Z"/>' if there else ""


def _dot(x: float, y: float, radius: float, kind: str) -> str:
    return f'<circle class="{kind}" cx="{x:.1f}" cy="{y:.1f}" r="{radius}"/>'


def _image(values: np.ndarray, kind: Kind, x: float, y: float, width: float, height: float) -> str:
    """Values (rows, columns) as colours; an image of a tenth of a megapixel would say no more at this size."""
    step = max(1, max(values.shape) // POINTS)
    values = values[::step, ::step]
    scale = Scale(kind)
    scale.fit(values)
    data = base64.b64encode(_png(scale.indices(values), gradient(kind.colors))).decode()
    keep = "none" if kind is ESTIMATE and width == WIDTH else "xMidYMid"
    return (
        f'<image x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{height:.1f}" preserveAspectRatio="{keep}" '
        f'href="data:image/png;base64,{data}"/>'
    )


def _png(indices: np.ndarray, colors: np.ndarray) -> bytes:
    """An image (rows, columns) of indices into colours (256, 3), as a PNG (ISO/IEC 15948)."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    rows, columns = indices.shape
    lines = np.hstack((np.zeros((rows, 1), np.uint8), indices.astype(np.uint8)))
    header = struct.pack(">IIBBBBB", columns, rows, 8, 3, 0, 0, 0)
    parts = [
        chunk(b"IHDR", header),
        chunk(b"PLTE", colors.tobytes()),
        chunk(b"IDAT", zlib.compress(lines.tobytes(), 9)),
    ]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts) + chunk(b"IEND", b"")


def _svg(parts: list[str]) -> str:
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" class="card-picture">'
        f"<style>{STYLE}</style>\n" + "\n".join(part for part in parts if part) + "\n</svg>\n"
    )
