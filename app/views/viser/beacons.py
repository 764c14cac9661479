"""Beacons that tell how far they are: where each stands, and around it the ring on which its last reading puts us."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
import viser

from estimators.log import READING
from estimators.model.state_space import StateSpaceModel
from estimators.track import FAILED, GATED

from ...present.drawing.geometry import circle
from ...present.drawing.palette import Palette, mixed
from .history import History

FADING = 10.0
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
        """Send where they stand, and what they told lately."""
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
            ring.visible = bool(age < FADING and far > 0)
            if ring.visible:
                refused = history.column("verdict")[mine[-1]] in (GATED, FAILED)
                color = self._palette.refused if refused else self._palette.reading
                color = mixed(color, self._palette.panel, 0.2 * round(4 * age / FADING))
                if tuple(ring.colors) != color:
                    ring.colors = np.array(color, np.uint8)
                ring.position, ring.scale = (*place, 0.03), (far, far, 1.0)
