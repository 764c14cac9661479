"""Whether what a twin's scene names is there: its states, its sensors, its parameters."""

from __future__ import annotations

from config.loader import Loaded
from estimators.errors import nearest
from estimators.model.state_space import StateSpaceModel

from .names import check_named


def check_scene(loaded: Loaded, model: StateSpaceModel) -> None:
    """Refuse a scene that names what the model does not have.

    Raises:
        ConfigError: With file and line, and the near names.
    """
    scene = loaded.config.view.scene
    for key in ("axes", "position", "heading", "parts", "charge", "temperature", "states"):
        value = getattr(scene, key) or ()
        names = (value,) if isinstance(value, str) else tuple(value.values()) if isinstance(value, dict) else value
        check_named(loaded, ("view", "scene", key), names, model)
    rows = {sensor.name: len(sensor.rows) for sensor in model.sensors}
    for key in ("beams", "beacons"):
        for name in getattr(scene, key):
            if name not in rows:
                text = f"names {name!r}, no sensor of {model.name}; {nearest(name, rows)}"
                raise loaded.error(("view", "scene", key), text)
    for name, angles in scene.beams.items():
        if len(angles) != rows[name]:
            text = f"has {len(angles)} angles; {name} has {rows[name]} rows, give one for each"
            raise loaded.error(("view", "scene", "beams", name), text)
    known = (*model.state_names, *(parameter.name for parameter in model.parameters))
    for name, place in scene.beacons.items():
        at = ("view", "scene", "beacons", name)
        if rows[name] != 1:
            raise loaded.error(at, f"is for one distance; {name} has {rows[name]} rows")
        for item in place:
            if item not in known:
                text = f"names {item!r}, no state or parameter of {model.name}; {nearest(item, known)}"
                raise loaded.error(at, text)
