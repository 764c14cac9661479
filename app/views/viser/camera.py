"""Cameras that use the pane that they have: the whole of a scene, as large as it fits, upright or across."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import viser

MARGIN = 0.94
"""Part of the view that is filled by what is to be seen."""

WORTH = 0.75
"""A scene is turned by a right angle if it then can be seen from that share of the distance."""

FAR = 20_000.0
"""Up to where a camera sees; a road may be long."""

SAME = 0.02
"""Relative change of a pane's aspect from which on it is another pane."""


class Outlook(NamedTuple):
    """What a camera is to see.

    points: What must be in the view, about the origin, shape (n, 3).
    direction: From the origin to the camera, shape (3,).
    up: What is up on the screen, shape (3,), not along the direction.
    fov: Angle from top to bottom, radians.
    turns: Whether the scene may be seen from its other side, a right angle about z to the right.
    """

    points: np.ndarray
    direction: np.ndarray
    up: np.ndarray
    fov: float
    turns: bool = False


def place(outlook: Outlook, aspect: float) -> tuple[np.ndarray, np.ndarray]:
    """Where a camera stands that looks at the origin, and its up: both (3,).

    Args:
        outlook: What it is to see.
        aspect: Width of the pane over its height.
    """
    straight = _distance(outlook, aspect)
    if outlook.turns:
        turned = outlook._replace(direction=_turned(outlook.direction), up=_turned(outlook.up))
        distance = _distance(turned, aspect)
        if distance < WORTH * straight:
            return _unit(turned.direction) * distance, turned.up
    return _unit(outlook.direction) * straight, outlook.up


def _distance(outlook: Outlook, aspect: float) -> float:
    """How far away a camera must stand to see the points, with a margin.

    A point c is seen if |c · r| <= tan(h/2) (d + c · f), with f forward, r to the right and h the angle across; so for
    what is up, with the angle from top to bottom.
    """
    forward = -_unit(outlook.direction)
    right = _unit(np.cross(forward, outlook.up))
    upright = np.tan(outlook.fov / 2)
    tangents = np.array([upright * max(aspect, 0.05), upright])
    aside = np.abs(outlook.points @ np.stack((right, np.cross(right, forward)), axis=1)) / (MARGIN * tangents)
    return float((aside.max(axis=1) - outlook.points @ forward).max())


def _unit(vector: np.ndarray) -> np.ndarray:
    return np.asarray(vector / np.linalg.norm(vector))


def _turned(vector: np.ndarray) -> np.ndarray:
    """A right angle to the right about z: what was north on the screen is to the left, east is up."""
    return np.array([vector[1], -vector[0], vector[2]])


class Cameras:
    """Gives each browser's camera its place: when it comes, when its pane changes its shape, and for another scene.

    Otherwise a camera is its user's, who turns it freely.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._outlook: Outlook | None = None
        self._first: np.ndarray | None = None
        self._aspects: dict[int, float] = {}

        async def connected(client: viser.ClientHandle) -> None:
            client.camera.on_update(updated)
            self._fit(client.camera)

        async def updated(camera: viser.CameraHandle) -> None:
            known = self._aspects.get(camera.client.client_id)
            # A browser may come to where all of them begin only after it got a place of its own.
            begins = self._first is not None and np.allclose(camera.position, self._first, rtol=1e-4)
            if known is None or abs(camera.aspect - known) > SAME * known or begins:
                self._fit(camera)

        async def gone(client: viser.ClientHandle) -> None:
            self._aspects.pop(client.client_id, None)

        server.on_client_connect(connected)
        server.on_client_disconnect(gone)

    def show(self, outlook: Outlook) -> None:
        """Look at another scene."""
        if self._outlook is None:
            # Once only: it would move the cameras of browsers that are there.
            camera = self._server.initial_camera
            self._first, camera.up = place(outlook, 1.0)
            camera.position = self._first
            camera.look_at, camera.fov, camera.far = np.zeros(3), outlook.fov, FAR
        self._outlook = outlook
        for client in self._server.get_clients().values():
            self._fit(client.camera)

    def _fit(self, camera: viser.CameraHandle) -> None:
        self._aspects[camera.client.client_id] = camera.aspect
        if self._outlook is None:
            return
        position, up = place(self._outlook, camera.aspect)
        with camera.client.atomic():
            camera.fov = self._outlook.fov
            camera.position = position
            camera.look_at = np.zeros(3)
            # Viser sends no direction that it takes to be the browser's already, and it takes one for it that a browser
            # which came to where all of them begin has lost again: so another one first.
            camera.up_direction = np.roll(up, 1)
            camera.up_direction = up
