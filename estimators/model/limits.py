"""What a sensor can say at all: readings beyond its limits are kept in the log and never used."""

from __future__ import annotations

from dataclasses import dataclass

from ..errors import ModelError

Pair = tuple[float, float]

NOISES = 8.0
"""Standard deviations by which noise alone may move two readings apart: chance does that once in 10⁸ readings, as the
difference of two has √2 standard deviations."""


@dataclass(frozen=True)
class Stuck:
    """When a row that repeats itself is stuck.

    It is from its `readings`-th equal value on, or from the one that comes `seconds` after the first of them. Values
    less than half a `quantum` apart are equal. Where neither number nor time is given, the run is as long as noise of
    standard deviation `std` makes less than once a day at the sensor's rate: see screen.py. `quantum` and `std` have
    one entry for all rows, or one a row; without `std`, the noise of the sensor's rows.
    """

    readings: int | None = None
    seconds: float | None = None
    quantum: tuple[float, ...] = ()
    std: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        """Refuse what would never, or always, be stuck."""
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
    """Limits of one sensor, in the units of its rows; each has one entry for all rows, or one a row.

    range: the least and the greatest value that can be. saturation: where its converter clips: values at either end or
    beyond say only that it is there. rate: the greatest change a second, against the last reading that kept all limits;
    the noise may add `NOISES` standard deviations. duplicates: seconds after a reading within which one of the same
    values is that reading again; of the same time it always is.
    """

    range: tuple[Pair, ...] = ()
    saturation: tuple[Pair, ...] = ()
    rate: tuple[float, ...] = ()
    stuck: Stuck | None = None
    duplicates: float = 0.0

    def __post_init__(self) -> None:
        """Refuse limits that no reading, or every one, would break."""
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
        """What does not fit a sensor of so many rows, as `key has 2 entries; ...`; None if all does."""
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
    """Refuse a range that holds nothing.

    Raises:
        ModelError: Beginning with `what`.
    """
    if pair is not None and not pair[0] < pair[1]:
        raise ModelError(f"{what} is {pair[0]:g} to {pair[1]:g}; the first must be below the second")


def check_limits(what: str, limits: Limits | None, rows: int) -> None:
    """Refuse limits that do not fit a sensor of so many rows.

    Raises:
        ModelError: Beginning with `what`.
    """
    wrong = limits.flaw(rows) if limits is not None else None
    if wrong:
        raise ModelError(f"{what}: {wrong}")
