"""The table of a fleet: in order, in parts, counted, and as text and files."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from app.format_time import counted
from app.result import Cell, JsonObject, TableColumn, Topic
from estimators.fleet.siblings import MIN_ASSETS, Siblings, siblings
from estimators.fleet.table import FleetTable
from estimators.model.state_space import StateSpaceModel
from estimators.track import HEALTH_NAMES, VERDICT_NAMES

BINS = 40
"""Bars of a histogram."""

OUTSIDE_SHARE = 0.005
"""Share of the assets beyond each end of a histogram, counted in its first or last bar."""


def counts_of(table: FleetTable) -> dict[str, int]:
    """Return the number of assets by health, the worst first."""
    counts = np.bincount(table.health, minlength=len(HEALTH_NAMES))
    return {name: int(count) for name, count in zip(HEALTH_NAMES[::-1], counts[::-1], strict=True)}


def value_columns(model: StateSpaceModel, table: FleetTable) -> dict[str, np.ndarray]:
    """Return the columns of numbers, (assets,) each, by which a table is sorted and of which histograms are drawn."""
    names = [state.name for state in model.shown_states]
    columns = dict(zip(names, table.mean.T, strict=True))
    columns |= {f"{name}_std": column for name, column in zip(names, table.std.T, strict=True)}
    lasting = table.seconds - table.since
    rest = {"nis": table.nis_mean, "age": table.age, "lasting": lasting, "seconds": table.seconds}
    return columns | rest | {"events": table.events}


def units_of(model: StateSpaceModel) -> dict[str, str]:
    """Return the unit of each column of `value_columns` that has one."""
    units = {state.name: state.unit for state in model.shown_states}
    return (
        units
        | {f"{name}_std": unit for name, unit in units.items()}
        | dict.fromkeys(("age", "lasting", "seconds"), "s")
    )


def ordered(model: StateSpaceModel, table: FleetTable, sort: str = "health", down: bool = True) -> np.ndarray:
    """Return the positions of all assets in an order, (assets,); those without a value come last.

    Args:
        model: The model.
        table: The table.
        sort: health (among equals by mean NIS over its upper bound), asset, or a column of `value_columns`.
        down: Whether the largest, or the worst, comes first.
    """
    if sort == "asset":
        order = np.argsort(np.array(table.assets, object), kind="stable")
        return order[::-1] if down else order
    if sort == "health":
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = np.nan_to_num(table.nis_mean / table.nis_high)
        return np.lexsort((-ratio, -table.health.astype(int))) if down else np.lexsort((ratio, table.health))
    values = np.asarray(value_columns(model, table)[sort], float)
    return np.argsort(-values if down else values, kind="stable")


def in_name_order(table: FleetTable) -> FleetTable:
    """Return a table with its assets in the order of their names."""
    order = np.argsort(np.array(table.assets, object), kind="stable")
    return FleetTable([table.assets[k] for k in order.tolist()], *(column[order] for column in table[1:]))


def matching(names: Sequence[str], words: str, within: np.ndarray) -> np.ndarray:
    """Return those of the positions `within` whose asset has all words of a search in its name."""
    wanted = words.lower().split()
    if not wanted:
        return within
    found = np.array([all(word in name.lower() for word in wanted) for name in names], np.bool_)
    return within[found[within]]


def histogram(values: np.ndarray) -> JsonObject | None:
    """Return the edges and counts of a histogram of the finite values; None without any."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return None
    low, high = np.quantile(finite, (OUTSIDE_SHARE, 1.0 - OUTSIDE_SHARE))
    if not low < high:
        low, high = low - 0.5, high + 0.5
    counts, edges = np.histogram(np.clip(finite, low, high), BINS, (low, high))
    return {"low": float(edges[0]), "high": float(edges[-1]), "counts": counts.tolist()}


def siblings_of(model: StateSpaceModel, table: FleetTable, column: str) -> Siblings | None:
    """Compare the assets in a state; None for other columns and for angles, and if there are too few assets."""
    for k, state in enumerate(model.shown_states):
        if state.name == column and not state.circular:
            if np.count_nonzero(np.isfinite(table.mean[:, k])) >= MIN_ASSETS:
                return siblings(table.mean[:, k], table.std[:, k])
    return None


def arrow_table(model: StateSpaceModel, table: FleetTable, order: np.ndarray | None = None) -> Any:
    """Return a pyarrow.Table with a row for each asset, in an order.

    Columns: `asset`, `health` and `cause` (or null); `NAME` and `NAME_std` for each state; `nis_mean`, `nis_low`,
    `nis_high`; `seconds` of the last event, `since` (last change of health), `age` of the last measurement, `verdict`
    on the last event; `events` folded and `stale`, those dropped as too late.
    """
    import pyarrow as pa

    part = slice(None) if order is None else order
    columns: dict[str, object] = {
        "asset": pa.array(np.array(table.assets, object)[part], pa.string()),
        "health": np.array(HEALTH_NAMES)[table.health[part]],
        "cause": pa.array([cause or None for cause in table.cause[part].tolist()], pa.string()),
    }
    for k, state in enumerate(model.shown_states):
        columns |= {state.name: table.mean[part, k], f"{state.name}_std": table.std[part, k]}
    names = ("nis_mean", "nis_low", "nis_high", "seconds", "since", "age")
    columns |= {name: getattr(table, name)[part] for name in names}
    columns["verdict"] = np.array(VERDICT_NAMES)[table.verdict[part]]
    columns |= {"events": table.events[part], "stale": table.stale[part]}
    return pa.table(columns)


def fleet_topics(model: StateSpaceModel, table: FleetTable, worst: int) -> list[Topic]:
    """Return the counts by health and the worst assets as text."""
    total, stale = len(table.assets), int(table.stale.sum())
    sentences = [f"{counted(total, 'asset')}, {counted(int(table.events.sum()), 'event')}."]
    if stale:
        sentences.append(f"{stale:,} events were too late to be inserted and were dropped; sort the rows by time.")
    counts = counts_of(table)
    rows = tuple((name, float(count), count / total) for name, count in counts.items() if count)
    columns = ("health", TableColumn("assets", 0), TableColumn("share [%]", 1, 100.0))
    states = [(k, state) for k, state in enumerate(model.shown_states)]
    heads: list[TableColumn | str] = ["asset", "health", "cause"]
    for _, state in states:
        heads += [TableColumn(f"{state.name} [{state.unit}]" if state.unit else state.name), TableColumn("σ")]
    heads += [TableColumn("NIS"), TableColumn("age [s]")]
    lines: list[tuple[Cell, ...]] = []
    for place in ordered(model, table)[:worst].tolist():
        values = [value for k, _ in states for value in (float(table.mean[place, k]), float(table.std[place, k]))]
        words = (str(table.assets[place]), HEALTH_NAMES[table.health[place]], str(table.cause[place]) or "-")
        lines.append((*words, *values, float(table.nis_mean[place]), float(table.age[place])))
    title = f"Worst {len(lines)} assets" if len(lines) < total else "Assets, worst first"
    return [
        Topic("Health", tuple(sentences), columns, rows),
        Topic(title, columns=tuple(heads), rows=tuple(lines)),
    ]
