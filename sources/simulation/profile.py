"""How an input of a simulated asset runs over time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Constant:
    """The same value always."""

    value: float

    def at(self, t: float) -> float:
        """Value at t seconds."""
        return self.value


@dataclass(frozen=True)
class Steps:
    """From each of `times` (s, rising) on, the value beside it; again from the start after `repeat` seconds."""

    times: tuple[float, ...]
    values: tuple[float, ...]
    repeat: float | None = None

    def at(self, t: float) -> float:
        """Value at t seconds; before the first time, the first value."""
        if self.repeat is not None:
            t = t % self.repeat
        return self.values[max(0, int(np.searchsorted(self.times, t, side="right")) - 1)]


@dataclass(frozen=True)
class Sine:
    """mean + amplitude · sin(2π t / period + phase); period in s, phase in rad."""

    mean: float
    amplitude: float
    period: float
    phase: float = 0.0

    def at(self, t: float) -> float:
        """Value at t seconds."""
        return self.mean + self.amplitude * float(np.sin(2.0 * np.pi * t / self.period + self.phase))


@dataclass(frozen=True)
class Sum:
    """Several profiles added up."""

    parts: tuple[Profile, ...]

    def at(self, t: float) -> float:
        """Value at t seconds."""
        return sum(part.at(t) for part in self.parts)


Profile = Constant | Steps | Sine | Sum
"""Any of them."""
