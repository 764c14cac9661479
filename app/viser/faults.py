"""The panel's folder of faults: a kind, a target, a size; put in, and end all."""

from __future__ import annotations

import html
from collections.abc import Callable

import viser

from estimators.errors import ConfigError
from estimators.model.state_space import StateSpaceModel
from sources.faults.kinds import KINDS

from ..engine.commands import ClearFault, Command, InjectFault
from ..engine.faults import fault_of, fault_text
from ..engine.outputs import Status

WHOLE = "the whole twin"

RATE = {"spike": 0.01}
"""What the panel gives to a kind whose rate has no default; the API takes any."""


class FaultRows:
    """What can be put into the source, and what holds."""

    def __init__(
        self,
        gui: viser.GuiApi,
        model: StateSpaceModel,
        submit: Callable[[Command], None],
        complain: Callable[[str], None],
    ) -> None:
        self._model, self._submit, self._complain = model, submit, complain
        self._text = ""
        parameters = tuple(item.name for item in model.parameters)
        # Of a parameter: of kind model alone, so that is left out where there is none.
        kinds = tuple(name for name in KINDS if parameters or name != "model")
        with gui.add_folder("Faults", expand_by_default=False):
            self.kind = gui.add_dropdown("Kind", kinds, initial_value=kinds[0], hint=KINDS[kinds[0]].help)
            targets = (*model.sensor_names, *(f"input.{name}" for name in model.input_names), WHOLE)
            self.target = gui.add_dropdown("Target", (*targets, *(f"parameter.{name}" for name in parameters)))
            self.size = gui.add_text(
                "Size", "", hint="In the unit of the target, seconds, or a factor, as the kind says"
            )
            self.inject = gui.add_button("Inject")
            self.stop = gui.add_button("Stop all")
            self.active = gui.add_html("")
        self.inject.on_click(self._inject)
        self.stop.on_click(self._stop)

    def _inject(self, event: viser.GuiEvent) -> None:
        if event.client is None:
            return
        text = self.size.value.strip().replace(",", ".")
        target = None if self.target.value == WHOLE else self.target.value
        takes = {item.name for item in KINDS[self.kind.value].parameters}
        try:
            number = float(text) if text else None
            command = InjectFault(
                self.kind.value,
                target,
                size=number if "size" in takes else None,
                every=number if "size" not in takes and "every" in takes else None,
                rate=RATE.get(self.kind.value),
            )
            fault_of(command, self._model)
        except ValueError:
            self._complain(f"Size is {text!r}; it must be a number")
            return
        except ConfigError as error:
            self._complain(str(error))
            return
        self._complain("")
        self._submit(command)

    def _stop(self, event: viser.GuiEvent) -> None:
        if event.client is not None:
            self._submit(ClearFault())

    def sync(self, status: Status) -> None:
        """Show what holds."""
        lines = [html.escape(fault_text(item.fault, self._model)) for item in status.faults]
        text = "<br>".join(lines) or "None holds."
        if text != self._text:
            self._text = text
            self.active.content = f'<div style="font-size:0.8em;padding:0 0.9em 0.5em">{text}</div>'
