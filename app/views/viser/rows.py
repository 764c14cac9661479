"""The rows of the panel: a slider and a field that show one number, and never argue with the user who turns it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import viser

from ...live.commands import Command
from .coalescer import Coalescer

DECADES = 3
"""Powers of ten that a logarithmic slider reaches to either side of the configured value."""

PATIENCE = 2.0
"""Seconds after an edit in which the engine's older value does not snap the row back."""


class Held:
    """Which value a row should show: the user's last edit for a while, then whatever the engine says."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._mine: tuple[Any, float] | None = None

    def edited(self, value: Any) -> None:
        """The user set a value."""
        self._mine = (value, self._clock() + PATIENCE)

    def shows(self, actual: Any) -> bool:
        """Whether the engine's value may be shown now."""
        if self._mine is None:
            return True
        value, until = self._mine
        if _same(value, actual) or self._clock() > until:
            self._mine = None
            return True
        return False


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, float) and isinstance(b, float):
        return math.isclose(a, b, rel_tol=1e-9)
    return a == b


def number_text(value: float) -> str:
    """A number as the field shows it: four digits, no more."""
    return f"{value:.4g}"


class NumberRow:
    """One variance: a logarithmic slider, which one that is configured as zero has not, and a field to type in."""

    def __init__(
        self,
        gui: viser.GuiApi,
        coalescer: Coalescer,
        *,
        key: str,
        label: str,
        unit: str,
        value: float,
        configured: float,
        command: Callable[[float], Command],
        complain: Callable[[str], None] = lambda text: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.key = key
        self._coalescer, self._command, self._complain = coalescer, command, complain
        self._held = Held(clock)
        self._value = value
        self._base = configured
        self.slider: viser.GuiSliderHandle[float] | None = None
        name = label.replace("_", " ")
        if configured > 0:
            note = f"Powers of ten from the configured {number_text(configured)} {unit}".strip()
            self.slider = gui.add_slider(
                name, -float(DECADES), float(DECADES), 0.01, self._place(value), marks=((0.0, ""),), hint=note
            )
        under = unit if self.slider is not None else f"{name} [{unit}]" if unit and unit != "1" else name
        self.field = gui.add_text(under or " ", number_text(value))
        self.field.on_update(self.typed)
        if self.slider is not None:
            self.slider.on_update(self.dragged)

    def dragged(self, event: viser.GuiEvent) -> None:
        """The user moved the slider."""
        if event.client is None or self.slider is None:
            return
        # The handle's value, not the event's: events run in a pool of threads and may overtake each other.
        place = self.slider.value
        value = float(f"{self._base * 10.0**place:.3g}")
        self._value = value
        self._held.edited(value)
        self.field.value = number_text(value)
        self._complain("")
        self._coalescer.dragged(self.key, self._command(value))

    def typed(self, event: viser.GuiEvent) -> None:
        """The user typed into the field."""
        if event.client is None:
            return
        text = self.field.value.strip().replace(",", ".")
        try:
            value = float(text)
        except ValueError:
            value = np.nan
        if not np.isfinite(value):
            self._coalescer.forget(self.key)
            self._complain(f"{self.key} is {text!r}; it must be a number" if text else "")
            return
        self._value = value
        self._held.edited(value)
        if self.slider is not None:
            self.slider.value = self._place(value)
        self._complain("")
        self._coalescer.typed(self.key, self._command(value))

    def sync(self, value: float) -> None:
        """Show the engine's value, unless the user's own is still on its way there."""
        if self._coalescer.waiting(self.key) or not self._held.shows(value) or _same(self._value, value):
            return
        self._value = value
        if self.slider is not None:
            self.slider.value = self._place(value)
        self.field.value = number_text(value)

    def _place(self, value: float) -> float:
        if value <= 0:
            return -float(DECADES)
        return float(np.clip(round(np.log10(value / self._base), 2), -DECADES, DECADES))


class ChoiceRow:
    """A dropdown or a checkbox: each edit is one command."""

    def __init__(self, handle: Any, submit: Callable[[Any], None], clock: Callable[[], float] = time.monotonic) -> None:
        self.handle = handle
        self._submit = submit
        self._held = Held(clock)
        handle.on_update(self.chosen)

    def chosen(self, event: viser.GuiEvent) -> None:
        """The user chose."""
        if event.client is None:
            return
        self._held.edited(self.handle.value)
        self._submit(self.handle.value)

    def sync(self, value: Any) -> None:
        """Show the engine's value, unless the user's own is still on its way there."""
        if self._held.shows(value) and self.handle.value != value:
            self.handle.value = value

    def remove(self) -> None:
        """Take the row off the panel."""
        self.handle.remove()
