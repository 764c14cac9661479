"""A motor cut open, each of its parts in the colours of its temperature: of the mean, and of 2σ to either side of it.

Slices of a part take turns, so one that is well known is of one colour, and one in doubt is striped.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import viser

from estimators.model.state_space import StateSpaceModel

from ...live.outputs import Belief
from ...present.drawing.geometry import about_z
from ...present.drawing.palette import Palette, mixed
from .camera import Outlook
from .history import History
from .scale_bar import ScaleBar

SLOTS, MAGNETS = 12, 8
CUT = 90.0
"""Degrees that are cut out of what stands still, up and to the right."""

TURNED = 0.3
"""Radians by which its axis is turned away from who looks."""

SIGMAS = (-2.0, 0.0, 2.0)

Sector = tuple[float, float, float, float, float]
"""Inner and outer radius, from which angle to which in degrees, half the length."""


def sectors(part: str) -> list[Sector]:
    """The slices of a part of the motor, whose outer radius is 1 and whose axis is y."""
    pitch, pole = 360.0 / SLOTS, 360.0 / MAGNETS
    if part == "yoke":
        return [(0.78, 1.0, angle, angle + 10.0, 0.6) for angle in np.arange(CUT, 360.0, 10.0)]
    if part == "tooth":
        middles = pitch * np.arange(SLOTS) + 0.5 * pitch
        return [(0.52, 0.78, a - 6.0, a + 6.0, 0.6) for a in middles if a > CUT]
    if part == "winding":
        # Coils are longer than the iron: their ends stand out.
        middles = pitch * np.arange(SLOTS + 1)
        return [(0.55, 0.76, max(CUT, a - 8.0), min(360.0, a + 8.0), 0.78) for a in middles if a >= CUT]
    return [(0.36, 0.47, pole * k + 4.0, pole * (k + 1) - 4.0, 0.6) for k in range(MAGNETS)]


def mesh(parts: list[Sector]) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 3) and triangles (m, 3) of some sectors of a ring about the y axis."""
    vertices, faces, count = [], [], 0
    for inner, outer, start, end, half in parts:
        angles = np.radians(np.linspace(start, end, max(2, int((end - start) / 4) + 1)))
        around = np.stack((np.cos(angles), np.zeros(angles.size), np.sin(angles)), axis=1)
        n, along = angles.size, np.array([0.0, half, 0.0])
        # Rings of points: inner front, outer front, outer back, inner back.
        vertices += [inner * around - along, outer * around - along, outer * around + along, inner * around + along]
        k = np.arange(n - 1)
        for ring in range(4):
            a, b = count + ring * n + k, count + (ring + 1) % 4 * n + k
            faces += [np.stack((a, b, b + 1), axis=1), np.stack((a, b + 1, a + 1), axis=1)]
        for side in (0, n - 1):
            corners = count + np.arange(4) * n + side
            faces.append(corners[[[0, 1, 2], [0, 2, 3]]])
        count += 4 * n
    return np.concatenate(vertices).astype(np.float32), np.concatenate(faces).astype(np.uint32)


class MotorScene:
    """The motor, and below it the scale of its colours with each part's temperature."""

    def __init__(self, api: viser.SceneApi, model: StateSpaceModel, parts: Mapping[str, str], palette: Palette) -> None:
        self._states = [model.state_names.index(name) for name in parts.values()]
        self.root = api.add_frame("/scene", show_axes=False)
        api.add_frame("/scene/motor", show_axes=False, wxyz=about_z(TURNED))
        flat = {"cast_shadow": False, "receive_shadow": False, "side": "double", "flat_shading": True}
        iron = mixed(palette.faint, palette.panel, 0.35)
        for name, solid in {
            "shaft": (0.0, 0.13, 0.0, 360.0, 1.0),
            "rotor": (0.13, 0.36, 0.0, 360.0, 0.6),
        }.items():
            api.add_mesh_simple(f"/scene/motor/{name}", *mesh([solid]), color=iron, **flat)
        self._parts: list[list[viser.MeshHandle]] = []
        for part in ("yoke", "tooth", "winding", "magnet"):
            slices = sectors(part)
            if part not in parts:
                api.add_mesh_simple(f"/scene/motor/{part}", *mesh(slices), color=iron, **flat)
        for part in parts:
            slices = sectors(part)
            self._parts.append([
                api.add_mesh_simple(f"/scene/motor/{part}/{k}", *mesh(slices[k :: len(SIGMAS)]), color=iron, **flat)
                for k in range(len(SIGMAS))
            ])  # fmt: skip
        unit = model.states[self._states[0]].unit
        self._bar = ScaleBar(api, "/scene/scale", list(parts), unit, palette, y=-0.8, top=-1.15)
        corners = np.array([[x, y, z] for x in (-1.05, 1.05) for y in (-0.8, 0.8) for z in (self._bar.bottom, 1.02)])
        middle = np.array([0.0, 0.0, 0.5 * (self._bar.bottom + 1.02)])
        self.root.position = -middle
        self.outlook = Outlook(
            corners - middle, np.array([0.0, -1.0, 0.28]), np.array([0.0, 0.0, 1.0]), float(np.radians(20))
        )

    def draw(self, history: History, belief: Belief, heavy: bool = True) -> None:
        """Send the colours of now."""
        if not heavy:
            return
        mean = belief.mean[self._states]
        std = np.sqrt(np.maximum(belief.cov[self._states, self._states], 0.0))
        self._bar.fit(mean, std)
        for handles, at, spread in zip(self._parts, mean, std, strict=True):
            for handle, sigmas in zip(handles, SIGMAS, strict=True):
                color = self._bar.color(at + sigmas * spread)
                if tuple(handle.color) != color:
                    handle.color = color
