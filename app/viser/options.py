"""The rows of the estimator's own options; another estimator brings other rows."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

import viser

from estimators.estimator import Estimator, Option

from ..engine.commands import Command, SetOption
from .coalescer import Coalescer
from .rows import ChoiceRow, NumberRow

WIDE = 100.0
"""Upper end of an option from which on it is typed: no slider is fine enough."""


class OptionRows:
    """A folder with a row for each option of the estimator that runs; not there if it has none."""

    def __init__(
        self,
        gui: viser.GuiApi,
        coalescer: Coalescer,
        submit: Callable[[Command], None],
        complain: Callable[[str], None],
    ) -> None:
        self._gui, self._coalescer, self._submit, self._complain = gui, coalescer, submit, complain
        self.folder = gui.add_folder("Options", expand_by_default=False)
        self.shown: str | None = None
        self.rows: dict[str, NumberRow | ChoiceRow] = {}
        self._choices: dict[str, tuple[str, ...]] = {}

    def sync(self, entry: Estimator, values: Mapping[str, float]) -> None:
        """Show the options of an estimator and what the engine says of them."""
        if entry.name != self.shown:
            self._build(entry, values)
        for name, row in self.rows.items():
            value = float(values[name])
            if isinstance(row, ChoiceRow):
                row.sync(self._choices[name][int(value)])
            else:
                row.sync(value)

    def _build(self, entry: Estimator, values: Mapping[str, float]) -> None:
        for row in self.rows.values():
            row.remove()
        self.shown = entry.name
        self._choices = {option.name: option.choices for option in entry.options if option.choices}
        with self.folder:
            self.rows = {option.name: self._row(entry, option, float(values[option.name])) for option in entry.options}
        self.folder.visible = bool(self.rows)

    def _row(self, entry: Estimator, option: Option, value: float) -> NumberRow | ChoiceRow:
        if option.choices:
            label = option.name.replace("_", " ")
            handle = self._gui.add_dropdown(
                label, option.choices, initial_value=option.choices[int(value)], hint=option.meaning
            )
            return ChoiceRow(
                handle, lambda text: self._submit(SetOption(option.name, float(option.choices.index(text))))
            )
        return NumberRow(
            self._gui, self._coalescer, key=f"{entry.name}.{option.name}", label=option.name, unit=option.unit,
            value=value, configured=option.default, low=option.low, hint=option.meaning, complain=self._complain,
            high=option.high if option.high <= WIDE else float("inf"), whole=option.whole,
            command=partial(SetOption, option.name),
        )  # fmt: skip
