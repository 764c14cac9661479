"""The panel's way back: what has been turned since the session began, and a button that undoes it."""

from __future__ import annotations

import html
from typing import Any

import viser

from estimators.registry import ESTIMATORS

from ..engine.changes import began_as, turned
from ..engine.commands import Restore
from ..engine.interface import Running
from ..engine.outputs import Status
from ..twin.twin import Twin

NAMED = 6
"""Settings that are named; of more it is said how many."""


class BeganRows:
    """One line and, while something differs, a button."""

    def __init__(self, gui: viser.GuiApi, engine: Running) -> None:
        self._engine = engine
        self._estimator: str | None = None
        self._tuning: Any = None
        self.line = gui.add_html("")
        self.button = gui.add_button(f"Back to as {began_as(engine.twin)}", visible=False)
        self.button.on_click(self._pressed)

    def sync(self, status: Status) -> None:
        """Show what the engine says."""
        if status.estimator == self._estimator and status.tuning is self._tuning:
            return
        self._estimator, self._tuning = status.estimator, status.tuning
        found = turned(self._engine.twin, status.estimator, status.tuning)
        self.line.content = began_html(self._engine.twin, found)
        self.line.visible = bool(self.line.content)
        self.button.visible = bool(found)

    def _pressed(self, event: viser.GuiEvent) -> None:
        if event.client is not None:
            self._engine.submit(Restore())


def began_html(twin: Twin, found: dict[str, Any]) -> str:
    """The line; of a twin that runs as its YAML says, nothing."""
    word = began_as(twin)
    title = html.escape(ESTIMATORS[twin.estimator].title)
    if found:
        parts = [html.escape(f"{_name(key)} {_text(twin, key, value)}") for key, value in list(found.items())[:NAMED]]
        more = f" and {len(found) - NAMED} more" if len(found) > NAMED else ""
        text = f"<b>Turned since {'the recording' if twin.recorded else 'the start'}.</b> As {word}: "
        text += f"{'; '.join(parts)}{more}."
    elif twin.recorded:
        text = f"<b>As recorded</b>: {title} and the settings below."
    else:
        return ""
    return f'<div style="font-size:0.8em;padding:0 0.9em 0.5em;overflow-wrap:anywhere">{text}</div>'


def _name(key: str) -> str:
    return key.removeprefix("options.").replace("_", " ")


def _text(twin: Twin, key: str, value: Any) -> str:
    """A setting for people."""
    if key == "estimator":
        return ESTIMATORS[value].title
    if key == "gate":
        return "off" if value is None else f"{100 * value:.6g} %"
    if key == "gate.kind":
        return str(value)
    if key == "gate.reopen":
        return "never" if value is None else f"{value:.6g} s"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if key.startswith("options."):
        option = next(option for option in ESTIMATORS[twin.estimator].options if f"options.{option.name}" == key)
        return option.choices[int(value)] if option.choices else f"{value:.6g} {option.unit}".strip()
    unit = next((item.unit for item in twin.tuning.items() if item.key == key), "")
    return f"{value:.6g} {unit}".strip()
