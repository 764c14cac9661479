"""Renderer of the chosen scene, one at a time, and the choices about it."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import viser

from config.schema import ViewSection
from estimators.errors import ConfigError
from estimators.model.state_space import StateSpaceModel

from ..charts.colors import LIGHT, kinds
from ..engine.copies import Belief
from ..engine.running_fold import Running
from ..result import JsonObject
from .belief_scene import BeliefScene
from .field_scenes import FieldScene, FieldSurfaceScene
from .machine_scenes import BatteryScene, GripperScene, MotorScene
from .scene import Cameras, History, Outlook
from .vehicle_scene import VehicleScene

BELIEF, FIELD, SURFACE = "belief", "field", "surface"
VEHICLE, MOTOR, BATTERY, GRIPPER = "vehicle", "motor", "battery", "gripper"
FOLLOW, STAY = "vehicle", "place"

FIELD_SCENES = (FieldScene, FieldSurfaceScene)  # Scenes of a large field, drawn from its pictures
AMBIENT, ABOVE = 2.5, 0.9  # Strength of the lights; π of the first alone would show each colour unchanged
HEAVY_PERIOD_S = 0.4  # Seconds between two redraws of lines and point clouds


class Scene(Protocol):
    """A scene below one frame; removing the frame removes the scene."""

    root: viser.FrameHandle
    outlook: Outlook

    def draw(self, history: History, belief: Belief, heavy: bool = True) -> None:
        """Send the present positions; lines and point clouds only if `heavy`."""


class SceneRenderer:
    """Builds the chosen scene, again after another choice, and draws it."""

    def __init__(self, server: viser.ViserServer, engine: Running) -> None:
        self._server, self._engine = server, engine
        api = server.scene
        api.set_up_direction("+z")
        # Nearly uniform light: colours have a meaning, so shading must not change them much.
        api.configure_default_lights(False)
        api.configure_environment_map(None)
        api.add_light_ambient("/light/all", intensity=AMBIENT)
        api.add_light_directional("/light/above", intensity=ABOVE, position=(-0.5, -1.0, 1.2))
        self.model, self._view = engine.model, engine.twin.config.view
        self._truth = engine.model.grid is not None and engine.twin.tells_field
        self.choices = Choices(choices_of(self.model, self._view, truth=self._truth))
        self.cameras = Cameras(server)
        self.palette = LIGHT
        self.scene: Scene | None = None
        self._built: object = None
        self._heavy = -HEAVY_PERIOD_S
        self._values: dict[str, str] = {}
        self._late = False
        """Whether lines and point clouds are still to be drawn."""
        self.prepare()

    def prepare(self) -> bool:
        """Build the chosen scene; return whether it is another one than before."""
        values = self.choices.values()
        show = values.get(SHOW, "")
        wanted = (show, *(values.get(axis) for axis in AXES if show == BELIEF), self.palette)
        fresh = wanted != self._built
        if fresh:
            if self.scene is not None:
                self.scene.root.remove()
            self.scene = self._build(show, values)
            self.cameras.show(self.scene.outlook)
            self._built, self._heavy = wanted, -HEAVY_PERIOD_S
            # Viser has a dark of its own.
            self._server.scene.set_background_image(np.full((2, 2, 3), self.palette.panel, np.uint8), format="png")
        self._late |= values != self._values
        self._values = values
        if isinstance(self.scene, FIELD_SCENES):
            self.scene.show(values["picture"])
        elif isinstance(self.scene, VehicleScene):
            self.scene.follow = values["follow"] == FOLLOW
        return fresh

    @property
    def due(self) -> bool:
        """Return whether to draw without new rows; a field decides itself."""
        return self._late or isinstance(self.scene, FIELD_SCENES)

    def draw(self, history: History, at: int | None = None) -> None:
        """Send changes at a time, ns, until which `history` has the rows; None is the newest row."""
        assert self.scene is not None
        now = time.monotonic()
        heavy = now - self._heavy >= HEAVY_PERIOD_S
        self._late = not heavy
        if heavy:
            self._heavy = now
        # The moments of a large field are expensive, and its pictures come with the rows.
        belief = self._engine.belief(at) if self.model.grid is None else None
        if isinstance(self.scene, VehicleScene):
            self.scene.tuning = self._engine.tuning
        self.scene.draw(history, belief, heavy)  # type: ignore[arg-type]

    def _build(self, show: str, values: dict[str, str]) -> Scene:
        api, model, section = self._server.scene, self.model, self._view.scene
        if show in (FIELD, SURFACE) and model.grid is not None:
            kind = FieldScene if show == FIELD else FieldSurfaceScene
            name = self._view.labels.get(model.grid.name, model.grid.name.replace("_", " "))
            return kind(api, model, self.palette, name, truth=self._truth)  # type: ignore[return-value]
        if show == VEHICLE:
            return VehicleScene(api, model, section, self.palette)
        if show == MOTOR:
            return MotorScene(api, model, section.parts or {}, self.palette)
        if show == BATTERY:
            return BatteryScene(api, model, section.charge or (), section.temperature, self.palette)
        if show == GRIPPER:
            return GripperScene(api, model, section.states or {}, self.palette)
        chosen = [values[axis] for axis in AXES if values.get(axis, NO_AXIS) != NO_AXIS]
        return BeliefScene(api, model, [model.state_names.index(name) for name in chosen], self.palette)


def choices_of(model: StateSpaceModel, view: ViewSection, *, truth: bool) -> list[Choice]:
    """Return the choices about the scenes of a twin; `truth` tells whether the true values of a field are known."""
    if model.grid is not None:
        titles = tuple(kind.title for kind in kinds(truth))
        return [Choice(SHOW, "Show", (FIELD, SURFACE), FIELD), Choice("picture", "Picture", titles, titles[0])]
    section = view.scene
    shows = tuple(dict.fromkeys((section.kind, BELIEF)))
    found = [Choice(SHOW, "Show", shows, shows[0])]
    if section.kind == VEHICLE:
        middles = (STAY, FOLLOW) if section.walls or section.beacons else (FOLLOW,)
        found.append(Choice("follow", "Middle", middles, middles[0], VEHICLE))
    names = [state.name for state in model.shown_states]
    first = [*(section.axes or section.position or ()), *([section.heading] if section.heading else [])]
    first = [*first, *(name for name in names if name not in first)][: 3 if section.axes is None else len(section.axes)]
    for axis, name in zip(AXES, [*first, *[NO_AXIS] * 3][: min(3, len(names))], strict=False):
        options = (*names, NO_AXIS) if axis == "z" else tuple(names)
        found.append(Choice(axis, axis, options, name if name != NO_AXIS or axis == "z" else names[0], BELIEF))
    return found


SHOW, NO_AXIS = "show", "none"
AXES = ("x", "y", "z")


@dataclass(frozen=True)
class Choice:
    """One choice: key, label, options and the initial option.

    `of` is the scene that it belongs to; None for a choice that all scenes have.
    """

    key: str
    label: str
    options: tuple[str, ...]
    first: str
    of: str | None = None


class Choices:
    """The choices and their values, and the time that is shown. Thread-safe.

    All browsers share one scene, so the page that pointed to a time last decides.
    """

    def __init__(self, choices: Iterable[Choice]) -> None:
        self._choices = {choice.key: choice for choice in choices}
        self._values = {choice.key: choice.first for choice in self._choices.values()}
        self._lock = threading.Lock()
        self._at: tuple[object, int | None] = (None, None)

    @property
    def at(self) -> int | None:
        """Time that the scene shows, ns; None is the newest row."""
        return self._at[1]

    def show(self, page: object, at: int | None) -> None:
        """Show a time, ns, for a page; None is the newest row."""
        self._at = page, at

    def leave(self, page: object) -> None:
        """Show the newest row again if a page that is gone had pointed to a time."""
        if self._at[0] is page:
            self._at = None, None

    def values(self) -> dict[str, str]:
        """Return the values by key."""
        with self._lock:
            return dict(self._values)

    def offered(self) -> list[Choice]:
        """Return the choices of the present scene that have more than one option."""
        show = self.values().get(SHOW)
        return [item for item in self._choices.values() if len(item.options) > 1 and item.of in (None, show)]

    def choose(self, key: str, value: str) -> None:
        """Set a choice; a state that another axis shows is exchanged with it.

        Raises:
            ConfigError: If there is no such choice or option.
        """
        choice = self._choices.get(key)
        if choice is None:
            raise ConfigError(f"scene: there is no choice {key!r}; there are {', '.join(self._choices)}")
        if value not in choice.options:
            raise ConfigError(f"scene: {key} is {value!r}; it must be one of {', '.join(choice.options)}")
        with self._lock:
            if key in AXES:
                other = next((axis for axis in AXES if axis != key and self._values.get(axis) == value), None)
                if other is not None and self._values[key] in self._choices[other].options:
                    self._values[other] = self._values[key]
                elif other is not None:
                    raise ConfigError(f"scene: {value} is on the {other} axis already")
            self._values[key] = value

    def json(self) -> list[JsonObject]:
        """Return the choices with their values, for the page."""
        values = self.values()
        return [
            {"key": item.key, "label": item.label, "options": list(item.options), "value": values[item.key]}
            for item in self.offered()
        ]
