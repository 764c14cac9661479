"""The beams of a vehicle's range finders: as far as the estimate has them reach, and what they read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import viser

from estimators.log import READING
from estimators.model.state_space import StateSpaceModel
from estimators.track import FAILED, GATED

from ...present.drawing.direct_readings import expected
from ...present.drawing.palette import Palette
from .history import History

RECENT = 3.0
"""Seconds after which a reading is no longer drawn: it says nothing of where the vehicle is now."""

HEIGHT = 0.12


class Beams:
    """Lines from the vehicle to where each beam should end, and dots where its reading says that it ended."""

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
        """Send the beams of a vehicle of state `mean` (nx,), at `place` (2,) on the plane; p are the parameters."""
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
        """Draw nothing: the vehicle is nowhere."""
        for handle in (self._expected, self._read, *self._dots):
            handle.visible = False

    @staticmethod
    def _last(history: History, sensor: int, rows: int) -> tuple[np.ndarray, bool]:
        """The newest reading of a sensor (rows,), NaN if it is too old, and whether it was refused."""
        mine = np.flatnonzero((history.column("kind") == READING) & (history.column("channel") == sensor))
        t = history.column("t")
        if not mine.size or t[-1] - t[mine[-1]] > RECENT * 1e9:
            return np.full(rows, np.nan), False
        return history.column("value")[mine[-1], :rows], bool(history.column("verdict")[mine[-1]] in (GATED, FAILED))

    @staticmethod
    def _put(handle: viser.LineSegmentsHandle, pairs: np.ndarray) -> None:
        pairs = pairs.reshape(-1, 2, 2)
        pairs = pairs[np.isfinite(pairs).all(axis=(1, 2))]
        handle.visible = bool(len(pairs))
        if len(pairs):
            handle.points = np.concatenate((pairs, np.full((len(pairs), 2, 1), HEIGHT)), axis=2).astype(np.float32)
