"""States, and fields of states on a grid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import prod
from typing import Any, overload

import numpy as np

from ..errors import ModelError
from .sensor import check_range


@dataclass(frozen=True)
class State:
    """One entry of x with its prior N(mean, std²); a `circular` one is an angle in radians and wraps to ±π.

    `position` is for filters that localise measurements. `fitted` is the range in which the model was fitted or
    checked; an estimate outside makes the twin suspect.
    """

    name: str
    unit: str
    mean: float = 0.0
    std: float = 1.0
    circular: bool = False
    position: tuple[float, ...] | None = None
    fitted: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        """Reject an empty range."""
        check_range(f"state {self.name}: fitted", self.fitted)


@dataclass(frozen=True)
class Field(Sequence[State]):
    """States of a quantity on a regular grid, the last index fastest; `field[k]` creates the k-th on access.

    Cell (i, j) lies at (i·spacing, j·spacing), or per axis if `spacing` is a tuple; along a `periodic` axis the grid
    closes on itself. `mean` and `std` are the prior of every cell, or `means` of each. `shown` are the cells whose
    estimates a track keeps, as flat indices; by default all of a small field, or 16 spread over a large one.
    """

    name: str
    unit: str
    shape: tuple[int, ...]
    spacing: float | tuple[float, ...] = 1.0
    periodic: tuple[bool, ...] = ()
    mean: float = 0.0
    std: float = 1.0
    means: tuple[float, ...] = ()
    shown: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        """Reject a grid without cells, and an invalid prior."""
        if not self.shape or min(self.shape) < 1:
            raise ModelError(f"field {self.name}: shape is {self.shape}; every axis needs at least one cell")
        if self.periodic and len(self.periodic) != len(self.shape):
            raise ModelError(f"field {self.name}: periodic is {self.periodic}; give one flag for each axis")
        if min(self.steps) <= 0 or len(self.steps) != len(self.shape):
            raise ModelError(f"field {self.name}: spacing is {self.spacing}; give one positive number, or one an axis")
        if self.means and len(self.means) != len(self):
            raise ModelError(f"field {self.name}: means has {len(self.means)} entries; give {len(self)}, or none")
        if not (np.all(np.isfinite(self.prior_mean)) and self.std > 0 and np.isfinite(self.std)):
            raise ModelError(f"field {self.name}: the prior must be finite, and its std positive; it is {self.std}")
        if self.shown and not (0 <= min(self.shown) and max(self.shown) < len(self)):
            raise ModelError(f"field {self.name}: shown names a cell outside 0 to {len(self) - 1}")

    @property
    def steps(self) -> tuple[float, ...]:
        """Distance between neighbours along each axis."""
        return self.spacing if isinstance(self.spacing, tuple) else (float(self.spacing),) * len(self.shape)

    @property
    def periods(self) -> tuple[float, ...]:
        """Length after which each axis repeats, infinite where it does not."""
        closed = self.periodic or (False,) * len(self.shape)
        return tuple(n * step if p else np.inf for n, step, p in zip(self.shape, self.steps, closed, strict=True))

    @cached_property
    def prior_mean(self) -> np.ndarray:
        """Prior mean of every cell, (nx,)."""
        return np.array(self.means) if self.means else np.full(len(self), float(self.mean))

    def positions(self) -> np.ndarray:
        """Return the positions of the cells, (nx, axes)."""
        axes = [np.arange(n) * step for n, step in zip(self.shape, self.steps, strict=True)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(len(self), len(self.shape))

    def index(self, value: Any, start: int = 0, stop: int | None = None) -> int:
        """Return the index of a state, by its name."""
        return self.index_of(value.name)

    def index_of(self, name: str) -> int:
        """Return the flat index of the cell of that name, `temperature[3,4]`.

        Raises:
            ValueError: If the field has no such cell.
        """
        head, _, rest = name.partition("[")
        if head != self.name or not rest.endswith("]"):
            raise ValueError(f"{name!r} is not a cell of {self.name}{list(self.shape)}")
        cell = tuple(int(part) for part in rest[:-1].split(","))
        if len(cell) != len(self.shape) or not all(0 <= i < n for i, n in zip(cell, self.shape, strict=True)):
            raise ValueError(f"{name!r} is not a cell of {self.name}{list(self.shape)}")
        return int(np.ravel_multi_index(cell, self.shape))

    def cell_name(self, k: int) -> str:
        """Return the name of a cell."""
        return f"{self.name}[{','.join(str(int(i)) for i in np.unravel_index(k, self.shape))}]"

    def __len__(self) -> int:
        return prod(self.shape)

    @overload
    def __getitem__(self, index: int) -> State: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[State]: ...
    def __getitem__(self, index: int | slice) -> State | Sequence[State]:
        if isinstance(index, slice):
            return tuple(self[k] for k in range(*index.indices(len(self))))
        if not -len(self) <= index < len(self):
            raise IndexError(f"field {self.name} has {len(self)} cells")
        k = index % len(self)
        cell = np.unravel_index(k, self.shape)
        return State(
            self.cell_name(k),
            self.unit,
            mean=float(self.means[k] if self.means else self.mean),
            std=float(self.std),
            position=tuple(float(i * step) for i, step in zip(cell, self.steps, strict=True)),
        )


class CellNames(Sequence[str]):
    """Names of a field's cells, created on access."""

    def __init__(self, field: Field) -> None:
        self._field = field

    def __len__(self) -> int:
        return len(self._field)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return tuple(self._field.cell_name(k) for k in range(*index.indices(len(self))))
        return self._field.cell_name(range(len(self))[index])

    def __contains__(self, name: object) -> bool:
        try:
            self._field.index_of(str(name))
        except ValueError:
            return False
        return True

    def index(self, value: Any, start: int = 0, stop: int | None = None) -> int:
        """Return the flat index of a cell by name."""
        return self._field.index_of(value)
