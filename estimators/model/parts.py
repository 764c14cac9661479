"""Parts of a model: states, fields of states on a grid, sensors, and limits of their measurements."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import prod
from typing import Any, overload

import numpy as np

from ..errors import ModelError


@dataclass(frozen=True)
class State:
    """One entry of x with its prior N(mean, std²); a `circular` one is an angle in radians and wraps to ±π.

    `position` is for filters that localise measurements. `fitted` is the range in which the model was fitted or
    checked; an estimate outside by more than `near` (default: 5 % of its width) makes the twin suspect. `withhold` is
    the half-width of its 95 % band beyond which it is not shown; nor is it where a state or an input is `far` or more
    outside its range (default: half of its width). `limits` are its physical limits: no error is larger than the
    distance between them. An `appended` one is a parameter or an error, whose corrections are not judged; a `watched`
    one makes the twin suspect when its own corrections are too large.
    """

    name: str
    unit: str
    mean: float = 0.0
    std: float = 1.0
    circular: bool = False
    position: tuple[float, ...] | None = None
    fitted: tuple[float, float] | None = None
    withhold: float = math.inf
    near: float | None = None
    far: float | None = None
    limits: tuple[float, float] | None = None
    appended: bool = False
    watched: bool = True

    def __post_init__(self) -> None:
        """Reject an empty range."""
        check_range(f"state {self.name}: fitted", self.fitted)
        check_range(f"state {self.name}: limits", self.limits)


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
        if not (np.all(np.isfinite(self.means or self.mean)) and self.std > 0 and np.isfinite(self.std)):
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

    def index(self, value: State, start: int = 0, stop: int | None = None) -> int:
        """Return the index of a state, by its name."""
        return self.index_of(value.name)

    def index_of(self, name: str) -> int:
        """Return the flat index of the cell of that name, `temperature[3,4]`.

        Raises:
            ValueError: If the field has no such cell.
        """
        head, _, rest = name.partition("[")
        own = head == self.name and rest.endswith("]")
        cell = tuple(int(part) for part in rest[:-1].split(",")) if own else ()
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

    def index(self, value: str, start: int = 0, stop: int | None = None) -> int:
        """Return the flat index of a cell by name."""
        return self._field.index_of(value)


Correlation = tuple[tuple[float, ...], ...]
"""A correlation matrix (ny, ny) by rows, which a frozen sensor can hold and compare."""

MIN_CORRELATION_EIGENVALUE = 1e-9
"""Smallest eigenvalue of a correlation; below it rows repeat each other up to rounding."""


def as_correlation(matrix: Sequence[Sequence[float]] | np.ndarray) -> Correlation:
    """Return the rows of a matrix, or of anything that NumPy converts to one."""
    return tuple(tuple(float(c) for c in row) for row in np.atleast_2d(np.asarray(matrix, float)))


def correlation_of(R: np.ndarray) -> Correlation:
    """Return the correlation c_ij = R_ij / √(R_ii R_jj) of a covariance R (ny, ny)."""
    R = np.asarray(R, float)
    std = np.sqrt(np.diag(R))
    c = R / np.outer(std, std)
    np.fill_diagonal(c, 1.0)
    return as_correlation(c)


def covariance_of(correlation: Correlation | None, r: np.ndarray) -> np.ndarray:
    """Return R (ny, ny) of rows with variances r (ny,); diagonal if they have no correlation."""
    if correlation is None:
        return np.diag(r)
    std = np.sqrt(r)
    R = np.array(correlation) * np.outer(std, std)
    np.fill_diagonal(R, r)
    return R


def correlation_error(correlation: Correlation, ny: int) -> str | None:
    """Return the flaw of a correlation of ny rows, with the remedy; None without one."""
    if len(correlation) != ny or any(len(row) != ny for row in correlation):
        return (
            f"has {len(correlation)} rows of {', '.join(str(len(row)) for row in correlation)}; it must be {ny} × {ny}"
        )
    c = np.array(correlation)
    if not np.all(np.isfinite(c)) or np.any(np.diag(c) != 1.0):
        return "must be finite, with ones on its diagonal; of a covariance R give R_ij / √(R_ii R_jj)"
    if not np.array_equal(c, c.T):
        return "is not symmetric; fill both triangles alike"
    least = np.linalg.eigvalsh(c)[0]
    if not least > MIN_CORRELATION_EIGENVALUE:
        remedy = (
            "leave out rows that repeat others" if least > -MIN_CORRELATION_EIGENVALUE else "lessen the correlations"
        )
        return f"is not positive definite (smallest eigenvalue {least:.2g}); {remedy}"
    return None


Pair = tuple[float, float]

RATE_NOISE_STDS = 8.0
"""Standard deviations by which noise alone may move two readings apart: chance does that once in 10⁸ readings, as the
difference of two has √2 standard deviations."""


@dataclass(frozen=True)
class Stuck:
    """When a row that repeats its value is stuck.

    It is stuck from its `readings`-th equal value on, or from a value `seconds` after the first of them. Values less
    than half a `quantum` apart are equal. Without number and time, the run is as long as noise of standard deviation
    `std` causes less than once a day at the sensor's rate (plausibility.py). `quantum` and `std` have one entry for all
    rows, or one per row; without `std`, the noise of the sensor's rows.
    """

    readings: int | None = None
    seconds: float | None = None
    quantum: tuple[float, ...] = ()
    std: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        """Reject rules that always or never apply."""
        if self.readings is None and self.seconds is None and not self.quantum:
            raise ModelError("stuck gives neither readings nor seconds nor quantum; add one")
        if self.readings is not None and self.readings < 2:
            raise ModelError(f"stuck.readings is {self.readings}; it must be 2 or more")
        for key, values in (("seconds", () if self.seconds is None else (self.seconds,)), ("quantum", self.quantum)):
            for value in values:
                if not value > 0:
                    raise ModelError(f"stuck.{key} is {value:g}; it must be positive")


@dataclass(frozen=True)
class Limits:
    """Limits of a sensor's measurements, in the units of its rows; each has one entry for all rows, or one a row.

    range: the smallest and largest possible value. saturation: where its converter clips: a value at either end or
    beyond is only a bound. rate: the largest change a second since the last measurement within all limits; noise may
    add `RATE_NOISE_STDS` standard deviations. duplicates: seconds after a measurement within which one of equal values
    is a copy of it; of the same time it always is. rests: whether the sensor may repeat its value for as long as it
    likes: no detector takes it for stuck. ends: the two ends of what its source can tell: a sensor that repeats one of
    them, or one of `range` where that is given, is named saturated, not stuck.
    """

    range: tuple[Pair, ...] = ()
    saturation: tuple[Pair, ...] = ()
    rate: tuple[float, ...] = ()
    stuck: Stuck | None = None
    duplicates: float = 0.0
    rests: bool = False
    ends: tuple[tuple[float, ...], ...] = ()

    def __post_init__(self) -> None:
        """Reject limits that no measurement, or every one, would violate."""
        for pair in self.range:
            check_range("range", pair)
        for pair in self.saturation:
            check_range("saturation", pair)
        for rate in self.rate:
            if not rate > 0:
                raise ModelError(f"rate is {rate:g}; it must be positive")
        if not self.duplicates >= 0:
            raise ModelError(f"duplicates is {self.duplicates:g} s; it must be zero or positive")

    def flaw(self, rows: int) -> str | None:
        """Return the key whose number of entries does not match the rows, as `key has 2 entries; ...`; None without."""
        stuck = self.stuck or Stuck(readings=2)
        for key, values in (
            ("range", self.range),
            ("saturation", self.saturation),
            ("rate", self.rate),
            ("stuck.quantum", stuck.quantum),
            ("stuck.std", stuck.std),
        ):
            if len(values) not in (0, 1, rows):
                return f"{key} has {len(values)} entries; give one, or {rows}, one a row"
        return None


def check_range(what: str, pair: Pair | None) -> None:
    """Reject an empty range.

    Raises:
        ModelError: Beginning with `what`.
    """
    if pair is not None and not pair[0] < pair[1]:
        raise ModelError(f"{what} is {pair[0]:g} to {pair[1]:g}; the first must be below the second")


@dataclass(frozen=True)
class Row:
    """One row of a sensor, with the variance of its noise; `circular` and `position` as in `State`."""

    name: str
    unit: str
    variance: float
    circular: bool = False
    position: tuple[float, ...] | None = None


@dataclass(frozen=True)
class Sensor:
    """A sensor: the rows of one measurement, and its prediction from the state.

    h(x, u, p, out) fills `out` (ny,). The optional H(x, u, p, out) fills the Jacobian (ny, nx). A sensor whose noise is
    not Gaussian gives log_likelihood(y, x, u, p, r) -> log p(y | x), with r (ny,) the rows' variances as they are tuned
    now; rows of y that are missing are NaN. Particle filters use it; the others use h and r.

    `correlation` is the correlation matrix (ny, ny) of the rows' noise, where they are not independent: anything that
    NumPy converts to a matrix. R_ij = correlation_ij √(r_i r_j), so the rows' variances are tuned as ever. Of a
    covariance R, give the rows its diagonal and the sensor `correlation_of(R)`.

    `limits` bound what it can measure; measurements beyond are kept in the log and never used. One that reports
    `by_chance`, as landmarks come into its view, has no rate and never drops out.

    A sensor of many landmarks declares the names and units of their coordinates as its `place`, for example
    (("east", "m"), ("north", "m")). Its h(x, u, p, place, out) also takes the coordinates of the measured landmark;
    `with_landmarks` makes a sensor for each, whose `family` is the declared one. Members of a family share one entry
    of the tuning.
    """

    name: str
    rows: tuple[Row, ...]
    h: Callable
    H: Callable | None = None
    log_likelihood: Callable | None = None
    correlation: Correlation | None = None
    limits: Limits | None = None
    by_chance: bool = False
    place: tuple[tuple[str, str], ...] = ()
    family: str = ""

    def __post_init__(self) -> None:
        """Store a matrix as its rows, which can be hashed."""
        if self.correlation is not None:
            object.__setattr__(self, "correlation", as_correlation(self.correlation))
