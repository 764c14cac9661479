"""Assets that differ from their siblings: planted ones of a simulated fleet, and days of a recorded plant as assets."""

from __future__ import annotations

import csv
from collections import defaultdict
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path

import numpy as np

from estimators import Fleet
from estimators.fleet.siblings import siblings
from estimators.fleet.table import FleetTable
from tests.models import level_model
from tests.skips import data_folder

from .timing import BenchmarkRow

COUNT, PLANTED, MEASUREMENTS = 10_000, 50, 30
PLANT = ("industrial_nab_temperature", "ambient_temperature_system_failure.csv")
HOURS = 20
"""Measurements from which on a day is compared."""


def found_siblings() -> Iterator[BenchmarkRow]:
    """Assets that differ from their siblings, at a false discovery rate of 5 %."""
    for shift in (2.5, 3.5):
        yield _simulated(shift)
    if (path := data_folder().joinpath(*PLANT)).is_file():
        yield _days(path)


def planted_fleet(shift: float) -> tuple[FleetTable, np.ndarray]:
    """Return the table of a fleet and its planted assets; levels differ by 0.5 (1 σ), theirs are off by `shift`."""
    rng = np.random.default_rng(3)
    level = 20.0 + 0.5 * rng.normal(size=COUNT)
    planted = rng.permutation(COUNT)[:PLANTED]
    level[planted] += shift
    fleet = Fleet("ekf", level_model({"gauge": 1.0}, 1e-12, mean=20.0, std=10.0), assets=COUNT)
    for step in range(MEASUREMENTS):
        fleet.add("gauge", np.arange(COUNT), np.full(COUNT, 0.1 * step), level + rng.normal(size=COUNT))
        fleet.advance()
    return fleet.table(), planted


def _simulated(shift: float) -> BenchmarkRow:
    table, planted = planted_fleet(shift)
    found = siblings(table.mean[:, 0], table.std[:, 0], rate=0.05)
    reported = np.flatnonzero(found.differs)
    right = np.intersect1d(reported, planted).size
    figures = {"assets": COUNT, "planted": PLANTED, "found": right, "missed": PLANTED - right,
               "false": reported.size - right, "mean": found.mean, "spread": found.std}  # fmt: skip
    return BenchmarkRow(f"off by {shift:g}", figures, (), "true mean 20, spread 0.5")


def _days(path: Path) -> BenchmarkRow:
    """Days as assets: the level of each is estimated from its hours, and its change since the day before compared."""
    days: dict[str, list[tuple[float, float]]] = defaultdict(list)
    with path.open() as file:
        for row in csv.DictReader(file):
            at = datetime.fromisoformat(row["timestamp"])
            days[f"{at:%Y-%m-%d}"].append((3600.0 * at.hour, float(row["value"])))
    names = sorted(name for name, hours in days.items() if len(hours) >= HOURS)
    fleet = Fleet("kf", level_model({"gauge": 1.0}, 1e-12, mean=70.0, std=10.0, linear=True), assets=names)
    for name in names:
        seconds, values = np.array(days[name]).T
        fleet.add("gauge", name, seconds, values)
    fleet.advance()
    table = fleet.table()
    change, std = np.diff(table.mean[:, 0]), np.hypot(table.std[1:, 0], table.std[:-1, 0])
    found = siblings(change, std, rate=0.05)
    which = ", ".join(names[1 + k] for k in np.flatnonzero(found.differs))
    figures = {"assets": len(names), "found": int(found.differs.sum()), "mean": found.mean, "spread": found.std}
    return BenchmarkRow("days of a plant", figures, (), which)
