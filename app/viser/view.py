"""The left pane of the page: scene, control panel and charts, served by Viser to any number of browsers."""

from __future__ import annotations

import threading
import time
from typing import Any

import viser

from ..engine.interface import Running
from ..engine.notices import Notice
from ..server.private_viser import guarded_server, unprinted
from .belief_scene import BeliefScene
from .charts import Charts
from .coalescer import Coalescer
from .field_chart import FieldChart
from .field_scene import FieldScene
from .history import History
from .panel import Panel
from .time_units import unit_for
from .vehicle_scene import VehicleScene

FRAME = 0.1
"""Seconds between two frames, when they are cheap."""

SHARE = 0.08
"""Part of a core that drawing may take: dearer frames come less often."""

SLOWEST = 2.0
"""Seconds between two frames at most."""

ROWS = 16_384
"""Rows pulled at once, so that a long history does not hold the engine's lock for long."""

COLUMN = 400
"""Width of the panel's and the charts' column, in pixels."""


class ViserView:
    """Pulls rows from the engine at its own rate, with a cursor of its own, and never keeps the engine waiting.

    `port` is known once the view is built; browsers reach it through the page's server only, which knows `secret`.
    """

    def __init__(self, engine: Running, *, secret: str) -> None:
        self.engine = engine
        view = engine.twin.config.view
        model = engine.model
        self.server = guarded_server(secret, engine.twin.title)
        self.port: int = self.server.get_port()
        gui = self.server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(37, 99, 235))
        gui.main_panel.dock_right()
        gui.main_panel.set_width(COLUMN)
        self.coalescer = Coalescer(engine.submit)
        self.panel = Panel(self.server, engine, self.coalescer)
        self.scene: VehicleScene | BeliefScene | FieldScene
        truth = model.grid is not None and engine.twin.tells_field
        if model.grid is not None:
            self.scene = FieldScene(self.server, model, truth=truth)
        elif view.scene.kind == "vehicle":
            self.scene = VehicleScene(self.server, model, view.scene)
        else:
            self.scene = BeliefScene(self.server, model, view.scene.axes)
        with self.panel.scene_folder:
            self.scene.controls(gui)
        below = gui.add_panel()
        with below.add_tab("Charts"):
            unit = unit_for(view.window)
            self.field_chart = FieldChart(gui, model.grid, unit, truth=truth) if model.grid is not None else None
            self.charts = Charts(self.server, model, view.window)
        below.dock_below(gui.main_panel)
        self.charts.window_choice.on_update(self._choose_window)
        if self.charts.state_choice is not None:
            self.charts.state_choice.on_update(self._choose_state)
        limit = 32_768 if model.grid is None else 4096
        self.history = History(len(model.shown), model.width, limit)
        self._rows = min(ROWS, limit)
        self._cursor: Any = None
        self._begin_again(view.window)
        self._revision: int | None = None
        self._wanted_window: str | None = None
        self._redraw = True
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="viser view", daemon=True)

    def start(self) -> None:
        """Begin to draw."""
        self._thread.start()

    def stop(self) -> None:
        """End drawing, and the server with it."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()
        self.engine.release(self._cursor)
        with unprinted():
            self.server.stop()

    def frame(self) -> None:
        """Bring the panel, the charts and the scene up to what the engine has now."""
        if self._wanted_window is not None:
            window, self._wanted_window = self.charts.windows[self._wanted_window], None
            self.charts.set_window(window)
            self._begin_again(window)
        changed = self._redraw
        notices: list[Notice] = []
        with self.server.atomic():
            while True:
                pull = self.engine.pull(self._cursor, self._rows)
                notices += pull.notices
                changed |= bool(len(pull.events)) or pull.fresh
                if pull.fresh:
                    self.charts.clear()
                if isinstance(self.scene, FieldScene):
                    self.scene.take(pull)
                first = self.history.take(pull)
                self.charts.update(self.history, max(0, first - self.history.trim()))
                if len(pull.events) < self._rows:
                    break
            if pull.revision != self._revision:
                self._revision = pull.revision
                self.charts.set_previous(self.engine.previous())
                changed = True
            if changed:
                self._redraw = False
                self.charts.draw(self.history)
                if not isinstance(self.scene, FieldScene):
                    self.scene.draw(self.history, self.engine.belief())
                elif self.field_chart is not None:
                    self.field_chart.draw(self.scene.numbers, self.history, self.charts.window, self.charts.unit)
            if isinstance(self.scene, FieldScene):
                self.scene.draw()
            self.panel.note(notices)
            self.panel.sync(self.engine.status(), self.history.origin, self.charts.unit)

    def _begin_again(self, window: float | None) -> None:
        """Pull the history from its start, to keep as much of it as the window shows."""
        if self._cursor is not None:
            self.engine.release(self._cursor)
        self._cursor = self.engine.cursor()
        self.history.clear()
        self.charts.clear()
        self.history.span = None if window is None else int(window * 1e9)

    def _choose_window(self, event: viser.GuiEvent) -> None:
        if event.client is not None:
            self._wanted_window = self.charts.window_choice.value

    def _choose_state(self, event: viser.GuiEvent) -> None:
        if event.client is not None and self.charts.state_choice is not None:
            self.charts.choose_state(self.charts.state_choice.value)
            self._redraw = True

    def _run(self) -> None:
        due = time.monotonic()
        while not self._stop.wait(FRAME / 2):
            self.coalescer.flush()
            now = time.monotonic()
            if now >= due:
                begun = time.thread_time()
                try:
                    self.frame()
                except Exception as error:  # noqa: BLE001  a picture that cannot be drawn must not end the others
                    self.engine.notices.report("view error", f"view error: {type(error).__name__}: {error}", "error")
                # This thread's own work counts, not the time it waited for its turn.
                due = now + min(SLOWEST, max(FRAME, (time.thread_time() - begun) / SHARE))
