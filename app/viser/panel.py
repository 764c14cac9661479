"""The control panel: what runs, what may be turned, and how it goes."""

from __future__ import annotations

import html
from collections import deque
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import viser

from estimators.registry import ESTIMATORS, unfit

from ..engine.commands import (
    Command,
    Maintenance,
    Pause,
    Record,
    Reset,
    Seek,
    SetEstimator,
    SetTuning,
    Speed,
    Step,
    UseSensor,
)
from ..engine.interface import Running
from ..engine.maintenance import LONGEST
from ..engine.notices import Notice
from ..engine.outputs import Status
from .coalescer import Coalescer
from .faults import FaultRows
from .options import OptionRows
from .restore import BeganRows
from .rows import ChoiceRow, Held, NumberRow
from .status import episodes_html, events_html, note_html, sensors_html, status_html
from .time_units import SECONDS, Unit

SPEEDS = {"0.1×": 0.1, "0.25×": 0.25, "0.5×": 0.5, "1×": 1.0, "2×": 2.0, "5×": 5.0, "10×": 10.0, "max": np.inf}
GATES = {"off": None, "95 %": 0.95, "99 %": 0.99, "99.73 %": 0.9973, "99.99 %": 0.9999}
EVERY = "all"
PAUSE, RESUME, STEP, RESET = "Pause", "Resume", "Step", "Reset"


class Panel:
    """Builds the panel once; `sync` brings it up to what the engine says."""

    def __init__(self, server: viser.ViserServer, engine: Running, coalescer: Coalescer) -> None:
        self._engine, self._coalescer = engine, coalescer
        self._configured = engine.twin.tuning
        self._events: deque[Any] = deque(maxlen=8)
        self._events_changed, self._unit = True, SECONDS
        self._shown: dict[str, str] = {}
        gui = server.gui
        self.status = gui.add_html("")
        self._note = gui.add_html("")
        status = engine.status()
        self.run_buttons = gui.add_button_group("Run", _buttons(status))
        self.run_buttons.on_click(self._pressed)
        tabs = gui.add_tab_group()
        self.rows: dict[str, NumberRow] = {}
        with tabs.add_tab("Tune"):
            self.began = BeganRows(gui, engine)
            self._build_estimator(gui, status)
            self._build_tuning(gui, status)
        with tabs.add_tab("Sensors"):
            gui.add_html('<div style="font-size:0.8em;padding:0 0.9em 0.6em">Off: held out. Predicted and scored, '
                         "never used.</div>")  # fmt: skip
            self._sensors_text = gui.add_html("")
            self.sensors = {name: self._sensor(gui, name, status) for name in engine.model.sensor_names}
            self.faults = FaultRows(gui, engine.model, engine.submit, self.complain)
        with tabs.add_tab("Play"):
            self._build_play(gui, status)
            self.scene_folder = gui.add_folder("Scene")
        with tabs.add_tab("Events"):
            self._episodes_list = gui.add_html("")
            self._events_list = gui.add_html("")

    def _build_estimator(self, gui: viser.GuiApi, status: Status) -> None:
        model = self._engine.model
        reasons = {name: unfit(entry, model) for name, entry in ESTIMATORS.items()}
        self._titles = {name: entry.title for name, entry in ESTIMATORS.items() if reasons[name] is None}
        names = {title: name for name, title in self._titles.items()}
        dropdown = gui.add_dropdown(
            "Estimator", tuple(names), initial_value=self._titles[status.estimator], hint="Folds the history again"
        )
        self.estimator = ChoiceRow(dropdown, lambda title: self._engine.submit(SetEstimator(names[title])))
        self.options = OptionRows(gui, self._coalescer, self._engine.submit, self.complain)
        refused = [
            f"<b>{ESTIMATORS[name].title}</b>: {html.escape(reason)}" for name, reason in reasons.items() if reason
        ]
        if refused:
            with gui.add_folder(f"Not here: {len(refused)}", expand_by_default=False):
                style = "font-size:0.75em;padding:0 0.9em 0.5em"
                gui.add_html(f'<div style="{style}">{"<br>".join(refused)}</div>')

    def _build_tuning(self, gui: viser.GuiApi, status: Status) -> None:
        configured = {item.key: item.value for item in self._configured.items()}
        titles = {"Q": "Process noise Q", "R": "Sensor noise R", "p": "Parameters"}
        room = len(configured) <= 4
        for prefix, title in titles.items():
            items = [item for item in status.tuning.items() if item.key.startswith(f"{prefix}.")]
            if not items:
                continue
            with gui.add_folder(title, expand_by_default=prefix == "Q" or room):
                for item in items:
                    self.rows[item.key] = NumberRow(
                        gui, self._coalescer, key=item.key, label=item.key.partition(".")[2], unit=item.unit,
                        value=item.value, configured=configured[item.key], low=item.low, high=item.high,
                        logarithmic=prefix != "p", complain=self.complain,
                        command=partial(SetTuning, item.key),
                    )  # fmt: skip
        self._gates = dict(GATES)
        if status.tuning.gate not in self._gates.values():
            self._gates[f"{status.tuning.gate:.6g}"] = status.tuning.gate
        dropdown = gui.add_dropdown(
            "Gate", tuple(self._gates), initial_value=self._gate_text(status.tuning.gate),
            hint="Probability with which a good reading passes; readings outside are not used",
        )  # fmt: skip
        self.gate = ChoiceRow(dropdown, lambda text: self._engine.submit(SetTuning("gate", self._gates[text])))

    def _gate_text(self, gate: float | None) -> str:
        for text, value in self._gates.items():
            if value == gate:
                return text
        self._gates[f"{gate:.6g}"] = gate
        self.gate.handle.options = tuple(self._gates)
        return f"{gate:.6g}"

    def _sensor(self, gui: viser.GuiApi, name: str, status: Status) -> ChoiceRow:
        box = gui.add_checkbox(name.replace("_", " "), bool(status.tuning.get(f"use.{name}")))
        return ChoiceRow(box, lambda used: self._engine.submit(UseSensor(name, used)))

    def _build_play(self, gui: viser.GuiApi, status: Status) -> None:
        speed = gui.add_dropdown("Speed", tuple(SPEEDS), initial_value="1×")
        self.speed = ChoiceRow(speed, lambda text: self._engine.submit(Speed(SPEEDS[text])))
        self.seek = gui.add_slider("Position [s]", 0.0, 1.0, 1.0, 0.0, marks=(), visible=False)
        self.seek.on_update(self._sought)
        self._sought_to = Held()
        with gui.add_folder("Maintenance", expand_by_default=False):
            names = [self._engine.model.state_names[k] for k in self._engine.model.shown]
            self.changed = gui.add_text("Changed", "", hint="What was changed in the asset")
            self.concerns = gui.add_dropdown(
                "State", (EVERY, *names), initial_value=EVERY, hint="Starts again as uncertain as at the beginning"
            )
            self.maintain = gui.add_button("Done", hint="Begins a new version of the model")
        self.maintain.on_click(self._maintained)
        with gui.add_folder("Recording"):
            self.file = gui.add_text("File", "", hint="Name of the .rrd file; empty: the twin's name and the time")
            self.record = gui.add_button("Record", color="red")
            self._record_state = gui.add_html("")
        self.record.on_click(self._record_pressed)

    def complain(self, text: str) -> None:
        """Show one line about an edit that cannot be used, or nothing."""
        self._show(self._note, "note", note_html(text))

    def note(self, notices: list[Notice]) -> None:
        """Take events from the engine."""
        if notices:
            self._events.extend(notices)
            self._events_changed = True

    def sync(self, status: Status, origin: int | None, unit: Unit = SECONDS) -> None:
        """Show what the engine says; whoever changed it, a browser, the API, or the engine itself."""
        self.began.sync(status)
        self.estimator.sync(self._titles.get(status.estimator, self.estimator.handle.value))
        self.options.sync(ESTIMATORS[status.estimator], status.options)
        for item in status.tuning.items():
            self.rows[item.key].sync(float(item.value))
        self.gate.sync(self._gate_text(status.tuning.gate))
        for name, box in self.sensors.items():
            box.sync(bool(status.tuning.get(f"use.{name}")))
        self.faults.sync(status)
        self._sync_play(status)
        recording = status.recording
        label = "Record" if recording is None else "Stop recording"
        if self.record.label != label:
            self.record.label = label
        text = "not recording" if recording is None else f"● recording {Path(recording).name}"
        style = "padding:0 0.9em 0.5em;font-size:0.8em;overflow-wrap:anywhere"
        self._show(self._record_state, "record", f'<div style="{style}">{html.escape(text)}</div>')
        self._show(self.status, "status", status_html(status, origin, unit))
        self._show(self._sensors_text, "sensors", sensors_html(status.sensors))
        self._show(self._episodes_list, "episodes", episodes_html(self._engine.episodes(), origin, unit))
        if self._events_changed or unit != self._unit:
            self._events_changed, self._unit = False, unit
            self._show(self._events_list, "events", events_html(list(self._events), origin, unit))

    def _sync_play(self, status: Status) -> None:
        labels = _buttons(status)
        if tuple(self.run_buttons.options) != labels:
            self.run_buttons.options = labels
        speed = next((text for text, factor in SPEEDS.items() if factor == status.speed), None)
        if speed is not None:
            self.speed.sync(speed)
        for handle, wanted in ((self.speed.handle, status.seekable), (self.seek, status.span is not None)):
            if handle.visible != wanted:
                handle.visible = wanted
        if status.span is None or status.t is None:
            return
        start, end = status.span
        length = float(max(1, -((start - end) // 1_000_000_000)))
        if self.seek.max != length:
            self.seek.max = length
        place = float(np.clip(np.floor((status.t - start) * 1e-9), 0.0, length))
        if not self._coalescer.waiting("seek") and self._sought_to.shows(place) and self.seek.value != place:
            self.seek.value = place

    def _show(self, handle: Any, key: str, content: str) -> None:
        if self._shown.get(key) != content:
            self._shown[key] = content
            handle.content = content

    def _pressed(self, event: viser.GuiEvent) -> None:
        if event.client is None:
            return
        buttons: dict[str, Command] = {PAUSE: Pause(True), RESUME: Pause(False), STEP: Step(), RESET: Reset()}
        command = buttons.get(event.target.value)
        if command is not None:
            self._engine.submit(command)

    def _maintained(self, event: viser.GuiEvent) -> None:
        if event.client is None:
            return
        chosen = self.concerns.value
        names = [name for name in self.concerns.options if name != EVERY] if chosen == EVERY else [chosen]
        what = " ".join(self.changed.value.split())[:LONGEST]
        if not what:
            self.complain("Maintenance: say what was changed")
            return
        self.complain("")
        self._engine.submit(Maintenance(what, tuple(names)))

    def _sought(self, event: viser.GuiEvent) -> None:
        if event.client is not None:
            place = float(self.seek.value)
            self._sought_to.edited(place)
            self._coalescer.typed("seek", Seek(place))

    def _record_pressed(self, event: viser.GuiEvent) -> None:
        if event.client is None:
            return
        if self._engine.status().recording is not None:
            self._engine.submit(Record(None))
            return
        # A bare name: a browser chooses what the file is called, not where on the disk it goes.
        name = Path(self.file.value.strip()).name
        if not name:
            name = f"{self._engine.twin.name}-{datetime.now():%Y%m%d-%H%M%S}.rrd"
        self._engine.submit(Record(Path(name if name.endswith(".rrd") else f"{name}.rrd")))


def _buttons(status: Status) -> tuple[str, ...]:
    """What can be done: a live source cannot be held up."""
    return (RESUME if status.paused else PAUSE, STEP, RESET) if status.seekable else (RESET,)
