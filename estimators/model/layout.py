"""What the events of a model may hold: how many rows each sensor has, how many inputs and states there are."""

from __future__ import annotations

from functools import cached_property

import numpy as np


class Layout:
    """How many rows each sensor of a model has, how many inputs and states: what its events may hold.

    Args:
        name: Of the model, for messages.
        sensors: Names of its sensors.
        rows: Rows of each.
        nu: Inputs.
        nx: States.
    """

    def __init__(self, name: str, sensors: tuple[str, ...], rows: tuple[int, ...], nu: int, nx: int) -> None:
        self.name, self.sensors, self.rows, self.nu, self.nx = name, sensors, rows, nu, nx

    def same(self, other: Layout | None) -> bool:
        """Whether both take the same events."""
        if other is None or self is other:
            return self is other
        return (self.rows, self.nu, self.nx) == (other.rows, other.nu, other.nx)

    @cached_property
    def least(self) -> int:
        """Columns of an event that a fold reads: those of the longest reading, or all inputs."""
        return max(*self.rows, self.nu)

    @cached_property
    def counts(self) -> np.ndarray:
        """Rows of each sensor."""
        return np.array(self.rows, np.int64)
