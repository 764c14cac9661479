"""A fleet behind one port: the overview of its assets, and the page of an asset on demand."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from starlette.responses import Response
from starlette.routing import BaseRoute, Mount
from starlette.staticfiles import StaticFiles

from app.extensions.service.metrics import exposed
from app.result import JsonObject
from app.web import readings
from app.web.http import get, page_file
from estimators.errors import ConfigError, nearest
from estimators.fleet.siblings import Siblings
from estimators.fleet.table import FleetTable
from estimators.track import HEALTH_NAMES

from .running import RunningFleet
from .table import counts_of, histogram, matching, ordered, siblings_of, units_of, value_columns

if TYPE_CHECKING:
    from prometheus_client.core import Metric

MAX_ROWS = 500
"""Longest part of the table that is sent at once."""

PAGE = Path(__file__).with_name("page")

MAX_ORDERS = 8
"""Orders of the table that are kept, for clients that scroll."""

DIGITS = 6
"""Significant digits of values of the overview."""


class _Order(NamedTuple):
    """Version of the table, and the settings that determine an order of its assets."""

    version: int
    sort: str
    down: bool
    find: str
    health: str
    differs: str
    """State in which they differ from the others, or empty."""


class FleetApi:
    """Answers with parts of the table of a running fleet."""

    def __init__(self, running: RunningFleet) -> None:
        self._running = running
        self._orders: OrderedDict[_Order, np.ndarray] = OrderedDict()
        self._siblings: tuple[tuple[int, str], Siblings | None] = ((-1, ""), None)
        self._lock = threading.Lock()
        self._arrived = False

    def routes(self) -> list[BaseRoute]:
        """Return the routes."""
        return [
            get("/api/fleet", self.rows),
            get("/metrics", self.metrics),
            Mount("/fleet", StaticFiles(directory=PAGE)),
            *readings.routes(self._running),
        ]

    def page(self, boot: str) -> Response:
        """Answer with the overview."""
        plan = self._running.plan
        columns = [*value_columns(plan.twin.model, self._running.table()[2])]
        sizes = {"fleet": plan.name, "title": plan.twin.title, "estimator": plan.twin.estimator, "columns": columns}
        units = units_of(plan.twin.model)
        states = [state.name for state in plan.twin.model.shown_states]
        return page_file(str(PAGE / "fleet.html"), {"boot": boot, **sizes, "units": units, "states": states})

    def rows(
        self,
        first: int = 0,
        count: int = 50,
        sort: str = "health",
        down: bool = True,
        find: str = "",
        health: str = "",
        column: str = "",
        differs: bool = False,
        version: int = -1,
    ) -> JsonObject:
        """Return a part of the table of all assets, in an order, with counts by health and a histogram of a column.

        `sort` is health, asset, or a column; `find` words in the name of an asset; `health` one grade; `differs` asks
        for those that differ from the others in `column`, a state. Of a `version` that is the present one, only that is
        answered.
        """
        running, model = self._running, self._running.plan.twin.model
        present, names, table = running.table()
        if version == present:
            return {"version": present}
        columns = value_columns(model, table)
        column = column or next(iter(columns))
        for key, value, valid in (
            ("sort", sort, ("health", "asset", *columns)),
            ("column", column, (*columns,)),
            ("health", health or HEALTH_NAMES[0], HEALTH_NAMES),
        ):
            if value not in valid:
                raise ConfigError(f"{key} is {value!r}; {nearest(value, valid)}")
        known = self._siblings_of(present, table, column)
        wanted = _Order(present, sort, down, find, health, column if differs else "")
        order = self._order(wanted, names, table, known)
        part = order[max(0, first) : max(0, first) + min(max(0, count), MAX_ROWS)]
        return {
            "version": present, "ended": running.ended, "failure": running.failure, "counts": counts_of(table),
            "assets": len(names), "found": order.size, "first": max(0, first),
            "refused": sum(running.counts.values()), "stale": int(table.stale.sum()),
            "column": column, "histogram": histogram(np.asarray(columns[column], float)),
            "siblings": None if known is None else
            {"mean": _short(known.mean), "std": _short(known.std), "differ": int(known.differs.sum())},
            "rows": [self._row(table, place) for place in part.tolist()],
        }  # fmt: skip

    def _row(self, table: FleetTable, place: int) -> JsonObject:
        numbers = [*table.mean[place], *table.std[place], table.nis_mean[place], table.nis_low[place],
                   table.nis_high[place], table.seconds[place] - table.since[place], table.age[place]]  # fmt: skip
        health, cause = HEALTH_NAMES[table.health[place]], str(table.cause[place])
        asset = str(table.assets[place])
        return {
            "asset": asset,
            "id": id_of(asset, place),
            "health": health,
            "cause": cause,
            "values": [*map(_short, numbers)],
        }

    def _siblings_of(self, version: int, table: FleetTable, column: str) -> Siblings | None:
        with self._lock:
            if self._siblings[0] != (version, column):
                self._siblings = (version, column), siblings_of(self._running.plan.twin.model, table, column)
            return self._siblings[1]

    def _order(self, wanted: _Order, names: list[str], table: FleetTable, known: Siblings | None) -> np.ndarray:
        with self._lock:
            found = self._orders.get(wanted)
            if found is None:
                found = ordered(self._running.plan.twin.model, table, wanted.sort, wanted.down)
                if wanted.health:
                    found = found[table.health[found] == HEALTH_NAMES.index(wanted.health)]
                if wanted.differs:
                    found = found[known.differs[found]] if known is not None else found[:0]
                found = self._orders[wanted] = matching(names, wanted.find, found)
            self._orders.move_to_end(wanted)
            while len(self._orders) > MAX_ORDERS:
                self._orders.popitem(last=False)
        return found

    def unready(self) -> str:
        """Return why the assets are not followed, not yet or not any more; empty if they are."""
        running = self._running
        self._arrived = self._arrived or bool(running.table()[2].events.any())
        return running.failure or ("" if self._arrived else "no measurement has arrived")

    def metrics(self) -> Response:
        """Answer with the counts of assets by health in the text format of Prometheus."""
        return exposed(_Collector(self._running))

    def find(self, name: str) -> str | None:
        """Return the asset that is meant by its id in an address; None if there is none."""
        names = self._running.names
        if name.startswith("@") and name[1:].isdecimal() and int(name[1:]) < len(names):
            return names[int(name[1:])]
        return self._running.find(name)


def id_of(asset: str, place: int) -> str:
    """Return the id of an asset in addresses: its name, unless that would be several parts of a path."""
    return f"@{place}" if "/" in asset or asset.startswith("@") or asset in (".", "..") else asset


def _short(value: float) -> float | None:
    return float(f"{value:.{DIGITS}g}") if np.isfinite(value) else None


class _Collector:
    """Metrics of a fleet, made anew for each scrape: a series for each grade of health, none for an asset."""

    def __init__(self, running: RunningFleet) -> None:
        self._running = running

    def collect(self) -> Iterator[Metric]:
        """Yield the metrics (prometheus_client's protocol)."""
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

        running = self._running
        _, _, table = running.table()
        name = running.plan.name
        health = GaugeMetricFamily("nisus_fleet_assets", "Assets by health.", labels=["fleet", "health"])
        for grade, count in counts_of(table).items():
            health.add_metric([name, grade], float(count))
        yield health
        events = CounterMetricFamily("nisus_fleet_events", "Folded events.", labels=["fleet"])
        events.add_metric([name], float(table.events.sum()))
        yield events
        stale = CounterMetricFamily("nisus_fleet_stale_events", "Events dropped as too late.", labels=["fleet"])
        stale.add_metric([name], float(table.stale.sum()))
        yield stale
        problems = CounterMetricFamily("nisus_problems", "Reported problems.", labels=["fleet", "kind"])
        for kind, count in running.counts.items():
            problems.add_metric([name, kind], float(count))
        yield problems
