"""Parts of the vehicle scene: trail of an estimate with several peaks, beacons with ranges, beams of range finders.

The track has the mean only, which lies between the peaks where the vehicle never was. Where the scene saw several peaks
the trail follows the heaviest one; rows of the mean between two such frames are left out.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import viser

from estimators.log import READING
from estimators.model.state_space import StateSpaceModel
from estimators.track import FAILED, GATED

from ...present.drawing.colors import Palette, mixed
from ...present.drawing.direct_readings import expected
from .scene import History, circle

MAX_FRAMES = 4096
"""Frames that are kept."""


class PeakTrail:
    """Frames of one scene: time, mean of its row, and the heaviest of several peaks, or NaN."""

    def __init__(self) -> None:
        self._looks: list[tuple[int, np.ndarray, np.ndarray]] = []

    def look(self, t: np.ndarray, mean: np.ndarray, peak: np.ndarray | None) -> None:
        """Keep the frame of the newest row.

        Args:
            t: Times of the rows, ns, (n,).
            mean: Position by the mean of each, (n, 2).
            peak: Position of the heaviest of several peaks, (2,); None if there is one.
        """
        if self._looks:
            then, place, _ = self._looks[-1]
            row = min(int(np.searchsorted(t, then, side="right")) - 1, len(t) - 1)
            # Rows that were rewritten, by another filter or a late measurement, had other peaks.
            if then > t[-1] or row >= 0 and t[row] == then and not np.array_equal(mean[row], place, equal_nan=True):
                self._looks.clear()
        seen = np.full(2, np.nan) if peak is None else np.array(peak, float)
        if self._looks and self._looks[-1][0] == t[-1]:
            self._looks.pop()
        self._looks = [*self._looks[-MAX_FRAMES + 1 :], (int(t[-1]), mean[-1].copy(), seen)]

    def of(self, t: np.ndarray, mean: np.ndarray) -> np.ndarray:
        """Return the trail, (m, 2): the mean, or the heaviest peak where there were several."""
        if not self._looks or not any(np.isfinite(peak[0]) for *_, peak in self._looks):
            return mean
        looks = np.array([then for then, *_ in self._looks])
        peaks = np.array([peak for *_, peak in self._looks])
        several = np.isfinite(peaks[:, 0])
        # The frame after each row; rows after the last frame are treated like it.
        led = np.minimum(np.searchsorted(looks, t), len(looks) - 1)
        kept = ~several[led]
        peaked = several & (looks >= t[0])
        times = np.concatenate((t[kept], looks[peaked]))
        return np.concatenate((mean[kept], peaks[peaked]))[np.argsort(times, kind="stable")]


FADING_S = 10.0
"""Seconds over which a ring pales; then it is gone."""

SIDES = 180


class Places:
    """Where beacons stand: in parameters, or in states that are estimated."""

    def __init__(self, model: StateSpaceModel, names: Iterable[tuple[str, str]]) -> None:
        states, parameters = list(model.state_names), [parameter.name for parameter in model.parameters]
        self._found = [
            [(True, states.index(item)) if item in states else (False, parameters.index(item)) for item in pair]
            for pair in names
        ]

    def at(self, mean: np.ndarray, p: np.ndarray) -> np.ndarray:
        """East and north of each (k, 2), from states (nx,) and parameters (np,)."""
        return np.array([[mean[j] if state else p[j] for state, j in pair] for pair in self._found]).reshape(-1, 2)


class Beacons:
    """A diamond for each beacon, and a ring where it was heard lately."""

    def __init__(
        self, api: viser.SceneApi, name: str, model: StateSpaceModel, beacons: Mapping[str, tuple[str, str]],
        palette: Palette, *, size: float,
    ) -> None:  # fmt: skip
        self._palette = palette
        sensors = [sensor.name for sensor in model.sensors]
        self._sensors = [sensors.index(sensor) for sensor in beacons]
        self._places = Places(model, beacons.values())
        self._marks = api.add_point_cloud(
            f"{name}/places", np.zeros((len(beacons), 3), np.float32), palette.ink, point_size=size,
            point_shape="diamond", precision="float32", point_shading="flat",
        )  # fmt: skip
        self._rings, self._texts = [], []
        for sensor in beacons:
            self._rings.append(
                api.add_line_segments(
                    f"{name}/{sensor}/ring", circle(SIDES), palette.reading, thickness=2, thickness_units="screen",
                    visible=False,
                )
            )  # fmt: skip
            text = sensor.replace("_", " ")
            self._texts.append(
                api.add_label(f"{name}/{sensor}/name", text, anchor="bottom-center", font_screen_scale=0.75)
            )
        self._size = size

    def draw(self, history: History, mean: np.ndarray, p: np.ndarray) -> None:
        """Send the positions of the beacons, and their recent ranges."""
        places = self._places.at(mean, p)
        points = np.column_stack((places, np.full(len(places), 0.2 * self._size))).astype(np.float32)
        if not np.array_equal(points, self._marks.points):
            self._marks.points = points
            for text, place in zip(self._texts, points, strict=True):
                text.position = place + [0.0, 0.6 * self._size, 0.0]
        t, kind, channel = (history.column(name) for name in ("t", "kind", "channel"))
        for ring, sensor, place in zip(self._rings, self._sensors, places, strict=True):
            mine = np.flatnonzero((kind == READING) & (channel == sensor))
            age = (t[-1] - t[mine[-1]]) / 1e9 if mine.size else np.inf
            far = float(history.column("value")[mine[-1], 0]) if mine.size else np.nan
            ring.visible = bool(age < FADING_S and far > 0)
            if ring.visible:
                refused = history.column("verdict")[mine[-1]] in (GATED, FAILED)
                color = self._palette.refused if refused else self._palette.reading
                color = mixed(color, self._palette.panel, 0.2 * round(4 * age / FADING_S))
                if tuple(ring.colors) != color:
                    ring.colors = np.array(color, np.uint8)
                ring.position, ring.scale = (*place, 0.03), (far, far, 1.0)


MAX_AGE_S = 3.0
"""Age in seconds from which a measurement is no longer drawn."""

HEIGHT = 0.12


class Beams:
    """Lines from the vehicle to the expected end of each beam, and dots at its measured end."""

    def __init__(
        self, api: viser.SceneApi, name: str, model: StateSpaceModel, angles: Mapping[str, Sequence[float]],
        palette: Palette, *, dot: float,
    ) -> None:  # fmt: skip
        self._model = model
        self._sensors = [k for k, sensor in enumerate(model.sensors) if sensor.name in angles]
        self._angles = [np.array(angles[model.sensors[k].name], float) for k in self._sensors]
        nothing, one = np.zeros((1, 2, 3), np.float32), np.zeros((1, 3), np.float32)
        line = {"thickness_units": "screen", "visible": False}
        self._expected = api.add_line_segments(f"{name}/expected", nothing, palette.estimate, thickness=1.5, **line)
        self._read = api.add_line_segments(f"{name}/read", nothing, palette.reading, thickness=1.5, **line)
        self._dots = [
            api.add_point_cloud(
                f"{name}/{kind}", one, color, point_size=dot, point_shape="circle", precision="float32",
                point_shading="flat", visible=False,
            )
            for kind, color in (("used", palette.reading), ("refused", palette.refused))
        ]  # fmt: skip

    def draw(self, history: History, mean: np.ndarray, place: np.ndarray, heading: float, p: np.ndarray) -> None:
        """Send the beams of a vehicle with state `mean` (nx,) at `place` (2,); p are the parameters."""
        expectations: list[tuple] = []
        readings: list[tuple] = []
        refusals: list[tuple] = []
        for k, angles in zip(self._sensors, self._angles, strict=True):
            should = expected(self._model, self._model.sensors[k], mean, p)
            read, refused = self._last(history, k, angles.size)
            for angle, far, seen in zip(angles, should, read, strict=True):
                way = np.array([np.cos(heading + angle), np.sin(heading + angle)])
                expectations.append((place, place + far * way))
                (refusals if refused else readings).append((place + far * way, place + seen * way))
        self._put(self._expected, np.array(expectations))
        self._put(self._read, np.array(readings + refusals))
        for handle, pairs in zip(self._dots, (readings, refusals), strict=True):
            ends = np.array([end for _, end in pairs]).reshape(-1, 2)
            ends = ends[np.isfinite(ends).all(axis=1)]
            handle.visible = bool(len(ends))
            if len(ends):
                handle.points = np.column_stack((ends, np.full(len(ends), HEIGHT + 0.05))).astype(np.float32)

    def hide(self) -> None:
        """Hide the beams while the position is unknown."""
        for handle in (self._expected, self._read, *self._dots):
            handle.visible = False

    @staticmethod
    def _last(history: History, sensor: int, rows: int) -> tuple[np.ndarray, bool]:
        """Return the newest measurement of a sensor (rows,), NaN if it is too old, and whether it was rejected."""
        mine = np.flatnonzero((history.column("kind") == READING) & (history.column("channel") == sensor))
        t = history.column("t")
        if not mine.size or t[-1] - t[mine[-1]] > MAX_AGE_S * 1e9:
            return np.full(rows, np.nan), False
        return history.column("value")[mine[-1], :rows], bool(history.column("verdict")[mine[-1]] in (GATED, FAILED))

    @staticmethod
    def _put(handle: viser.LineSegmentsHandle, pairs: np.ndarray) -> None:
        pairs = pairs.reshape(-1, 2, 2)
        pairs = pairs[np.isfinite(pairs).all(axis=(1, 2))]
        handle.visible = bool(len(pairs))
        if len(pairs):
            handle.points = np.concatenate((pairs, np.full((len(pairs), 2, 1), HEIGHT)), axis=2).astype(np.float32)
