"""Cameras that see the same scene in a narrow pane as in a wide one."""

from __future__ import annotations

import numpy as np
import viser

MARGIN = 0.9
"""Part of the view that is filled by what it was made for."""


def fit_cameras(server: viser.ViserServer, fov: float) -> None:
    """Give every browser's camera an angle of at least `fov` radians, both across and from top to bottom.

    Three.js fixes the vertical angle only, so a pane that is higher than wide would cut the scene at its sides. The
    angle alone is set: where a user's camera stands, and where it looks, stays the user's.
    """
    server.initial_camera.fov = fov

    async def fit(camera: viser.CameraHandle) -> None:
        wanted = vertical_angle(fov, camera.aspect)
        if abs(camera.fov - wanted) > 1e-3:
            camera.fov = wanted

    async def connected(client: viser.ClientHandle) -> None:
        client.camera.on_update(fit)
        await fit(client.camera)

    server.on_client_connect(connected)


def vertical_angle(fov: float, aspect: float) -> float:
    """The vertical angle at which a view of that aspect (width over height) spans `fov` in its narrower direction."""
    return float(2 * np.arctan(np.tan(fov / 2) / min(1.0, max(aspect, 0.1))))


def distance_for(places: np.ndarray, direction: np.ndarray, fov: float) -> float:
    """How far away a camera must stand to see some places, with a margin, looking at the origin.

    A place c is seen if |c · r| <= tan(fov/2) (d + c · f), with f forward and r to the right, or up.

    Args:
        places: Shape (n, 3).
        direction: From the origin to the camera, shape (3,), not vertical; z is up.
        fov: Angle of the view across and from top to bottom, radians.
    """
    forward = -direction / np.linalg.norm(direction)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    aside = np.abs(places @ np.stack((right, np.cross(right, forward)), axis=1)).max(axis=1)
    return float((aside / (MARGIN * np.tan(fov / 2)) - places @ forward).max())
