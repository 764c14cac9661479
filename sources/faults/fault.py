"""What a fault is: which kind, of what, from when to when, and how strong."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf


@dataclass(frozen=True)
class Fault:
    """One fault, from `start` until `end`, in seconds after the source's first event (or after it was injected).

    It concerns a `sensor` (a `row` of it, or all), an `input` or, of kind model, a true `parameter` of a simulated
    asset; none of them means the whole source. What the numbers mean, in which unit, and which of them a kind takes, is
    in `kinds.KINDS`; None is the kind's default. Draws are a function of `seed`, by default (seed of the layer, number
    of the fault), and of the events alone.
    """

    kind: str
    sensor: str | None = None
    input: str | None = None
    parameter: str | None = None
    row: str | None = None
    other: str | None = None
    start: float = 0.0
    end: float = inf
    size: float | None = None
    rate: float | None = None
    every: float | None = None
    count: int | None = None
    seed: int | None = None

    @property
    def target(self) -> str:
        """What it concerns, in words."""
        name = self.sensor or self.input or self.parameter or "the whole twin"
        return f"{name}.{self.row}" if self.row is not None else name
