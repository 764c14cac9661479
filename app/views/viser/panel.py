"""The panel of Viser's own window: how the estimate is, which estimator, Q and R, NIS. The page has all the rest."""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import viser

from estimators.errors import ConfigError
from estimators.registry import ESTIMATORS, unfit

from ...live.commands import SetEstimator, SetTuning
from ...live.interface import Running
from ...present.drawing.choices import Choice
from .coalescer import Coalescer
from .history import History
from .nis_chart import NisChart
from .rows import ChoiceRow, NumberRow
from .stage import Stage
from .status import note_html, status_html
from .time_units import unit_for

REDRAWN = 0.5
"""Seconds between two redraws of the chart."""

WIDTH = 360
"""Of the panel, in pixels."""


class Panel:
    """Builds the panel once; `sync` brings it up to what the engine says."""

    def __init__(self, server: viser.ViserServer, engine: Running, coalescer: Coalescer, stage: Stage) -> None:
        self._engine, self._coalescer, self._stage = engine, coalescer, stage
        self._unit = unit_for(engine.twin.config.view.window)
        self._shown: dict[str, Any] = {}
        gui = self._gui = server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=stage.palette.estimate)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(WIDTH)
        self.status = gui.add_html("")
        self._note = gui.add_html("")
        status = engine.status()
        fitting = {name: entry.title for name, entry in ESTIMATORS.items() if unfit(entry, engine.model) is None}
        names = {title: name for name, title in fitting.items()}
        self._titles = fitting
        dropdown = gui.add_dropdown(
            "Estimator", tuple(names), initial_value=fitting[status.estimator], hint="Folds the history again"
        )
        self.estimator = ChoiceRow(dropdown, lambda title: engine.submit(SetEstimator(names[title])))
        self.nis = NisChart(gui, self._unit)
        self._drawn = -REDRAWN
        self.rows: dict[str, NumberRow] = {}
        configured = {item.key: item.value for item in engine.twin.tuning.items()}
        for prefix, title in {"Q": "Process noise Q", "R": "Sensor noise R"}.items():
            items = [item for item in status.tuning.items() if item.key.startswith(f"{prefix}.")]
            if not items:
                continue
            with gui.add_folder(title):
                for item in items:
                    self.rows[item.key] = NumberRow(
                        gui, coalescer, key=item.key, label=item.key.partition(".")[2], unit=item.unit,
                        value=item.value, configured=configured[item.key], complain=self.complain,
                        command=partial(SetTuning, item.key),
                    )  # fmt: skip
        self._scene = gui.add_folder("Scene")
        self.choices: dict[str, ChoiceRow] = {}
        self._offer()

    def complain(self, text: str) -> None:
        """Show one line about an edit that cannot be used, or nothing."""
        self._show(self._note, "note", note_html(text, self._stage.palette))

    def sync(self, history: History, origin: int | None) -> None:
        """Show what the engine says; whoever changed it, a browser, the API, or the engine itself."""
        status = self._engine.status()
        self.estimator.sync(self._titles.get(status.estimator, self.estimator.handle.value))
        for item in status.tuning.items():
            if item.key in self.rows:
                self.rows[item.key].sync(float(item.value))
        self._show(self.status, "status", status_html(status, origin, self._unit, self._stage.palette))
        self._offer()
        now = time.monotonic()
        state = (status.revision, history.base + history.n, origin)
        if origin is not None and now - self._drawn >= REDRAWN and self._shown.get("nis") != state:
            self._shown["nis"], self._drawn = state, now
            self.nis.draw(history, origin)

    def _offer(self) -> None:
        """The choices about the scene: those that there are now, and what is chosen."""
        offered = self._stage.choices.offered()
        if self._shown.get("choices") != offered:
            self._shown["choices"] = offered
            for row in self.choices.values():
                row.remove()
            with self._scene:
                self.choices = {item.key: self._choice(item) for item in offered}
            self._scene.visible = bool(offered)
        values = self._stage.choices.values()
        for key, row in self.choices.items():
            row.sync(values[key])

    def _choice(self, item: Choice) -> ChoiceRow:
        chosen = self._stage.choices.values()[item.key]
        handle = self._gui.add_dropdown(item.label, item.options, initial_value=chosen)
        return ChoiceRow(handle, partial(self._chosen, item.key))

    def _chosen(self, key: str, value: str) -> None:
        try:
            self._stage.choices.choose(key, value)
        except ConfigError as error:
            self.complain(str(error))
        else:
            self.complain("")

    def _show(self, handle: Any, key: str, content: str) -> None:
        if self._shown.get(key) != content:
            self._shown[key] = content
            handle.content = content
